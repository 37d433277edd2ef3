// A head of a GLB with a person of some hundred bytes on it, as skinned vertices.
//
//   g++ -std=c++17 -O3 -o person person.cpp
//   facepipe export head.usdc --for persons --no-meshopt -o head.glb && facepipe basis -o head.fpbasis
//   ./person head.glb head.fpbasis me.fpb --weights jawOpen=0.5 smileLeft=1 -o me.obj
//
// Without basis and person it is the head itself. Bones are posed by the coefficients in the person, or those of
// --pose, of which it shows the first frame. OUT.obj has vertices in metres and triangles, any other name float32 x y z
// of all vertices, primitive after primitive. Exit 0 done; 1 done, but some meshes stayed as they were; 2 bad input, in
// one line.

#include <cstdio>
#include <iostream>

#include "glb.hpp"

using namespace facepipe;

struct Words {
  std::vector<std::string> files;  // head, then basis and person
  std::map<std::string, double> weights;
  std::string pose, out;
};

static Words parse(int count, char** words) {
  Words found;
  bool weights = false;
  for (int i = 1; i < count; ++i) {
    const std::string word = words[i];
    if (word == "-o" || word == "--pose") {
      if (++i == count) throw Error(word, "no file, expected one");
      (word == "-o" ? found.out : found.pose) = words[i];
      weights = false;
    } else if (word == "--weights") {
      weights = true;
    } else if (weights) {
      const std::size_t cut = word.rfind('=');
      char* end = nullptr;
      const double value = cut == std::string::npos ? NAN : std::strtod(word.c_str() + cut + 1, &end);
      if (!std::isfinite(value) || *end || cut + 1 == word.size())
        throw Error("--weights " + word, "expected NAME=VALUE");
      found.weights[word.substr(0, cut)] = value;
    } else {
      found.files.push_back(word);
    }
  }
  if ((found.files.size() != 1 && found.files.size() != 3) || found.out.empty())
    throw Error(
        "person",
        "expected HEAD.glb [BASIS.fpbasis ME.fpb] [--weights NAME=VALUE ...] [--pose POSE.fpb] -o OUT.bin|OUT.obj");
  return found;
}

static void check_names(const Head& head, const Words& words) {
  for (const auto& [name, value] : words.weights) {
    bool known = false;
    for (const HeadMesh& mesh : head.meshes)
      for (const Target& target : mesh.targets) known = known || target.shape == name;
    if (!known) throw Error("--weights " + name, "no such shape in " + words.files[0]);
  }
}

static std::vector<double> coefficients(const Head& head, const Bytes& payload, const std::string& where) {
  if (payload.empty()) return {};
  Poses poses = read_poses(payload, where);
  if (poses.joints != head.joints.size())
    throw Error(where, "made for other joints, expected " + std::to_string(head.joints.size()));
  poses.values.resize(9 * poses.joints);
  for (std::size_t i = 0; i < poses.values.size(); ++i)
    if (i % 9 < 3) poses.values[i] *= poses.meters_per_unit;
  return poses.values;
}

static void write(const std::string& path, const Head& head, const std::vector<float>& vertices) {
  const bool text = path.size() > 4 && path.compare(path.size() - 4, 4, ".obj") == 0;
  std::FILE* file = std::fopen(path.c_str(), "wb");
  if (!file) throw Error(path, "can't be written");
  if (!text) {
    for (float value : vertices) {
      std::uint32_t bits;
      std::memcpy(&bits, &value, sizeof bits);
      for (int shift = 0; shift < 32; shift += 8) std::fputc(static_cast<int>(bits >> shift & 255), file);
    }
  } else {
    for (std::size_t i = 0; i < vertices.size(); i += 3)
      std::fprintf(file, "v %.7g %.7g %.7g\n", vertices[i], vertices[i + 1], vertices[i + 2]);
    std::size_t first = 1;
    for (const Primitive& one : head.primitives) {
      for (std::size_t i = 0; i + 2 < one.triangles.size(); i += 3)
        std::fprintf(file, "f %zu %zu %zu\n", first + one.triangles[i], first + one.triangles[i + 1],
                     first + one.triangles[i + 2]);
      first += one.vertices();
    }
  }
  const bool failed = std::ferror(file);
  if (std::fclose(file) || failed) throw Error(path, "can't be written whole");
}

int main(int count, char** arguments) try {
  const Words words = parse(count, arguments);
  Head head = read_head(read_file(words.files[0]), words.files[0]);
  check_names(head, words);
  std::vector<std::string> left;
  Bytes pose;
  if (words.files.size() == 3) {
    const Basis basis = read_basis(read_file(words.files[1]), words.files[1]);
    const Person person = read_person(read_file(words.files[2]), words.files[2]);
    pose = person.coefficients;
    left = put_on(head, basis, rebuild(basis, person, words.files[2]), words.files[0]);
  }
  if (!words.pose.empty()) pose = read_file(words.pose);
  const std::string& where = words.files.back();
  const std::vector<double> posed = coefficients(head, pose, words.pose.empty() ? where : words.pose);
  const std::vector<float> vertices = skinned(head, words.weights, posed);
  write(words.out, head, vertices);
  std::cout << words.out << ": " << vertices.size() / 3 << " vertices\n";
  for (const std::string& name : left)
    std::cerr << "person: " << name << " stays as it is: the GLB does not say what it goes with\n";
  return left.empty() ? 0 : 1;
} catch (const std::exception& error) {
  std::cerr << "person: " << error.what() << "\n";
  return 2;
}
