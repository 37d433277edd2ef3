// What samples/cpp/facepipe.hpp makes of the cases of tests/support/person_corpus.py.
//
//   corpus persons BASIS CASES   a line a case: "ok", and figures of the points and joints; or "no"
//   corpus bases CASES           the same of bases: of all of their modes, and a step of 1 mm of all numbers of joints
//   corpus poses CASES           the same of bone coefficients: nine numbers a joint and frame, then times
//   corpus points BASIS FPB OUT  points and joints as float64
//   corpus lids BASIS FPB OUT    offsets of the shapes of lids as float64, and prints their names and weights
//   corpus time BASIS FPB        milliseconds of processor time: the basis, then a person, then its lids

#include <cstdio>
#include <ctime>

#include "../../../samples/cpp/facepipe.hpp"

using namespace facepipe;

static std::vector<Bytes> cases(const char* path) {
  const Bytes file = read_file(path);
  std::vector<Bytes> found;
  for (std::size_t place = 0; place < file.size();) {
    const std::size_t size = detail::little32(&file[place]);
    found.emplace_back(file.begin() + place + 4, file.begin() + place + 4 + size);
    place += 4 + size;
  }
  return found;
}

static void figures(const std::vector<double>& values) {
  double size = 0, weighted = 0;
  for (std::size_t i = 0; i < values.size(); ++i) {
    size += std::abs(values[i]);
    weighted += values[i] * (1 + i % 7);
  }
  const double count = values.empty() ? 1.0 : static_cast<double>(values.size());
  std::printf(" %.9g %.9g", size / count, weighted / count);
}

// Joints with how they are turned, and how shapes are.
static std::vector<double> whole(const Rebuilt& made) {
  std::vector<double> numbers = made.joints;
  for (const std::vector<double>& more : {made.turns, made.shapes}) numbers.insert(numbers.end(), more.begin(), more.end());
  return numbers;
}

template <class Case>
static void line(const Case& of) {
  try {
    const Rebuilt made = of();
    std::printf("ok");
    figures(made.points);
    figures(whole(made));
    std::printf("\n");
  } catch (const Error& error) {
    std::printf("no\n");
    if (std::strchr(error.what(), '\n')) std::abort();
  }
}

// Lids of whatever points: offsets, or one line.
static void try_lids(const Basis& basis, const Rebuilt& made) {
  try {
    fitted_lids(basis, made, "case");
  } catch (const Error&) {
  }
}

static double seconds() { return static_cast<double>(std::clock()) / CLOCKS_PER_SEC; }

int main(int count, char** words) {
  const std::string what = count > 2 ? words[1] : "";
  if (what == "bases") {
    for (const Bytes& one : cases(words[2]))
      line([&] {
        const Basis basis = read_basis(one, "case");
        Person person;
        person.basis = basis.digest;
        person.modes.assign(basis.mode_count, 1.0);
        person.joints.assign(9 * basis.identity.count(), 1);
        person.joint_step = 1;
        Rebuilt made = rebuild(basis, person, "case");
        const auto more = [&](const std::vector<double>& some) {
          made.joints.insert(made.joints.end(), some.begin(), some.end());
        };
        if (basis.lids.rings.empty()) return made;
        try_lids(basis, made);
        more(basis.lids.reach);
        for (const LidEye& eye : basis.lids.eyes) {
          more({eye.centre[0], eye.centre[1], eye.centre[2]}), more(eye.shares), more(eye.balls), more(eye.stretches);
          more(eye.ends), more(eye.ways);
        }
        return made;
      });
    return 0;
  }
  if (what == "poses") {
    for (const Bytes& one : cases(words[2]))
      line([&] {
        const Poses poses = read_poses(one, "case");
        return Rebuilt{poses.values, std::vector<double>(poses.times.begin(), poses.times.end()), {}, {}};
      });
    return 0;
  }
  const double before = seconds();
  const Basis basis = read_basis(read_file(words[2]), words[2]);
  if (what == "persons") {
    for (const Bytes& one : cases(words[3]))
      line([&] {
        const Rebuilt made = rebuild(basis, read_person(one, "case"), "case");
        try_lids(basis, made);
        return made;
      });
    return 0;
  }
  const double loaded = seconds();
  const Bytes data = read_file(words[3]);
  if (what == "time") {
    for (int i = 0; i < 20; ++i) rebuild(basis, read_person(data, words[3]), words[3]);
    const double made = seconds();
    const Rebuilt face = rebuild(basis, read_person(data, words[3]), words[3]);
    const double start = seconds();
    for (int i = 0; i < 20; ++i) fitted_lids(basis, face, words[3]);
    std::printf("%.1f %.2f %.2f\n", 1e3 * (loaded - before), 50 * (made - loaded), 50 * (seconds() - start));
    return 0;
  }
  const Rebuilt made = rebuild(basis, read_person(data, words[3]), words[3]);
  std::ofstream out(words[4], std::ios::binary);
  const auto write = [&](const std::vector<double>& values) {
    out.write(reinterpret_cast<const char*>(values.data()), static_cast<std::streamsize>(8 * values.size()));
  };
  if (what == "lids") {
    for (const LidShape& shape : fitted_lids(basis, made, words[3])) {
      std::printf("%s %g\n", shape.name.c_str(), shape.weight);
      write(shape.offsets);
    }
    return 0;
  }
  write(made.points), write(whole(made));
  return 0;
}
