// A head of `facepipe export --for persons` (or without --for): its vertices, morph targets, joints and skin, with a
// person of facepipe.hpp on it. Metres, Y up, as glTF has them. docs/files.md, "glTF". Numbers of any component type
// are read, sparse ones too (KHR_mesh_quantization); buffers that are compressed are not.

#pragma once

#include <cstdlib>
#include <map>
#include <set>

#include "facepipe.hpp"

namespace facepipe {

constexpr std::size_t kMostValues = 3000000;  // of JSON
constexpr std::size_t kMostTargets = 10000;
constexpr std::size_t kMostJoints = 1024;
constexpr std::size_t kMostNodes = 1 << 16;
constexpr std::size_t kLongestPath = 1 << 12;

namespace detail {

// A value of JSON. What is not there reads as a value of no kind, so that questions may be chained.
struct Json {
  enum Kind { kNone, kNumber, kText, kList, kObject } kind = kNone;
  double number = 0;
  std::string text;
  std::vector<std::pair<std::string, Json>> items;  // of lists without names

  const Json& operator[](const char* name) const {
    for (const auto& [key, value] : items)
      if (kind == kObject && key == name) return value;
    return none();
  }
  const Json& at(std::size_t place) const {
    return kind == kList && place < items.size() ? items[place].second : none();
  }
  std::size_t size() const { return kind == kList ? items.size() : 0; }
  bool is_there() const { return kind != kNone; }

  static const Json& none() {
    static const Json nothing;
    return nothing;
  }
};

class JsonReader {
 public:
  JsonReader(const char* text, std::size_t size, std::string where)
      : next_(text), end_(text + size), where_(std::move(where)) {}

  Json whole() {
    Json found = value(0);
    skip();
    if (next_ != end_) wrong();
    return found;
  }

 private:
  [[noreturn]] void wrong() const {
    throw Error(where_, "JSON that ends early, nests more than 64 deep, has over 3,000,000 values or is none");
  }

  void skip() {
    while (next_ != end_ && (*next_ == ' ' || *next_ == '\n' || *next_ == '\r' || *next_ == '\t')) ++next_;
  }

  char peek() {
    skip();
    if (next_ == end_) wrong();
    return *next_;
  }

  void expect(char wanted) {
    if (peek() != wanted) wrong();
    ++next_;
  }

  Json value(int depth) {
    if (depth > 64 || ++count_ > kMostValues) wrong();
    const char first = peek();
    Json found;
    if (first == '"') {
      found.kind = Json::kText;
      found.text = text();
    } else if (first == '{' || first == '[') {
      const bool named = first == '{';
      const char last = named ? '}' : ']';
      found.kind = named ? Json::kObject : Json::kList;
      ++next_;
      while (peek() != last) {
        if (!found.items.empty()) expect(',');
        std::string name;
        if (named) {
          peek();
          name = text();
          expect(':');
        }
        Json own = value(depth + 1);
        found.items.emplace_back(std::move(name), std::move(own));
      }
      ++next_;
    } else {
      word(found);
    }
    return found;
  }

  void word(Json& found) {
    const char* start = next_;
    while (next_ != end_ && std::strchr("+-.0123456789Eeaflnrstu", *next_) && *next_) ++next_;
    const std::string own(start, next_);
    if (own == "true" || own == "false" || own == "null") {
      found.kind = own == "null" ? Json::kNone : Json::kNumber;
      found.number = own == "true";
      return;
    }
    char* after = nullptr;
    found.kind = Json::kNumber;
    found.number = std::strtod(own.c_str(), &after);
    if (own.empty() || *after || !std::isfinite(found.number)) wrong();
  }

  std::string text() {
    expect('"');
    std::string found;
    while (next_ != end_ && *next_ != '"') {
      if (*next_ != '\\') {
        found += *next_++;
      } else {
        if (end_ - next_ < 2) wrong();
        const char kind = next_[1];
        next_ += 2;
        if (kind == 'u')
          unicode(found);
        else
          found += kind == 'n'   ? '\n'
                   : kind == 't' ? '\t'
                   : kind == 'r' ? '\r'
                   : kind == 'b' ? '\b'
                   : kind == 'f' ? '\f'
                                 : kind;
      }
    }
    expect('"');
    return found;
  }

  std::uint32_t four_digits() {
    if (end_ - next_ < 4) wrong();
    std::uint32_t code = 0;
    for (int i = 0; i < 4; ++i, ++next_) {
      const char* digits = "0123456789abcdef";
      const char* place = *next_ ? std::strchr(digits, *next_ >= 'A' && *next_ <= 'F' ? *next_ + 32 : *next_) : nullptr;
      if (!place) wrong();
      code = code << 4 | static_cast<std::uint32_t>(place - digits);
    }
    return code;
  }

  void unicode(std::string& found) {
    std::uint32_t code = four_digits();
    if (code >> 10 == 0x36 && end_ - next_ > 6 && next_[0] == '\\' && next_[1] == 'u') {
      next_ += 2;
      code = 0x10000 + ((code & 1023) << 10) + (four_digits() & 1023);
    }
    if (code < 0x80) {
      found += static_cast<char>(code);
      return;
    }
    const int more = code < 0x800 ? 1 : code < 0x10000 ? 2 : 3;
    found += static_cast<char>((more == 1 ? 0xC0 : more == 2 ? 0xE0 : 0xF0) | code >> 6 * more);
    for (int i = more - 1; i >= 0; --i) found += static_cast<char>(0x80 | (code >> 6 * i & 63));
  }

  const char *next_, *end_;
  std::size_t count_ = 0;
  std::string where_;
};

// The numbers of a GLB's accessors, no more of them than its bytes are worth.
class Numbers {
 public:
  Numbers(const Json& document, const std::uint8_t* bytes, std::size_t size, std::string where)
      : document_(document),
        bytes_(bytes),
        size_(size),
        where_(std::move(where)),
        left_((64.0 * (1 << 20) + 32.0 * size) / 4) {}

  // Numbers of an accessor, `width` for each element, and how many elements it has.
  std::vector<float> of(const Json& number, std::size_t width) {
    const Json& accessor = document_["accessors"].at(index(number, "accessor"));
    static const std::map<std::string, std::size_t> widths = {
        {"SCALAR", 1}, {"VEC2", 2}, {"VEC3", 3}, {"VEC4", 4}, {"MAT4", 16}};
    const auto found = widths.find(accessor["type"].text);
    if (found == widths.end() || found->second != width) wrong("an accessor of another type");
    const std::size_t count = index(accessor["count"], "count");
    if ((left_ -= static_cast<double>(count) * static_cast<double>(width)) < 0)
      wrong("more numbers than its bytes are worth");
    std::vector<float> values(count * width);
    if (accessor["bufferView"].is_there()) read(accessor, accessor, count, width, values);
    const Json& sparse = accessor["sparse"];
    if (sparse.is_there()) {
      const std::size_t some = index(sparse["count"], "count");
      if (some > count) wrong("more sparse elements than there are");
      std::vector<float> places(some), changed(some * width);
      read(sparse["indices"], sparse["indices"], some, 1, places);
      read(sparse["values"], accessor, some, width, changed);
      for (std::size_t i = 0; i < some; ++i) {
        const std::size_t place = static_cast<std::size_t>(places[i]);
        if (place >= count) wrong("a sparse element that is not there");
        std::copy_n(&changed[i * width], width, &values[place * width]);
      }
    }
    return values;
  }

  // Whole numbers below a bound.
  std::vector<std::uint32_t> whole(const Json& number, std::size_t width, std::size_t bound, const char* what) {
    std::vector<std::uint32_t> found;
    for (float value : of(number, width)) {
      if (!(value >= 0 && value < static_cast<double>(bound) && value == std::floor(value)))
        wrong(std::string(what) + " that are not there");
      found.push_back(static_cast<std::uint32_t>(value));
    }
    return found;
  }

  std::size_t index(const Json& value, const char* what) const {
    if (value.kind != Json::kNumber || !(value.number >= 0 && value.number < 1u << 31) ||
        value.number != std::floor(value.number))
      wrong(std::string("a ") + what + " that is no whole number");
    return static_cast<std::size_t>(value.number);
  }

  [[noreturn]] void wrong(const std::string& what) const { throw Error(where_, what); }

 private:
  void read(const Json& where, const Json& of, std::size_t count, std::size_t width, std::vector<float>& values) const {
    const Json& view = document_["bufferViews"].at(index(where["bufferView"], "bufferView"));
    const auto part = [&](const Json& json, const char* name) {
      return json[name].is_there() ? index(json[name], name) : 0;
    };
    const std::size_t type = index(of["componentType"], "componentType"), size = type < 5122 ? 1 : type < 5125 ? 2 : 4;
    if (type < 5120 || type > 5126 || type == 5124) wrong("a component type that glTF has not");
    const std::size_t start = part(view, "byteOffset"), length = part(view, "byteLength"),
                      offset = part(where, "byteOffset");
    const std::size_t own = part(view, "byteStride"), stride = own ? own : size * width;
    if (part(view, "buffer") || start > size_ || length > size_ - start)
      wrong("a view that leaves the buffer of the GLB");
    if (stride < size * width || (count && (offset > length || size * width > length - offset ||
                                            (count - 1) > (length - offset - size * width) / stride)))
      wrong("an accessor that leaves its view");
    const bool scaled = of["normalized"].number != 0;
    for (std::size_t i = 0; i < count; ++i)
      for (std::size_t k = 0; k < width; ++k) {
        const float value = number(bytes_ + start + offset + i * stride + k * size, type, scaled);
        if (!std::isfinite(value)) wrong("a number that is not finite");
        values[i * width + k] = value;
      }
  }

  static float number(const std::uint8_t* data, std::size_t type, bool scaled) {
    const int two = type < 5122 ? 0 : data[0] | data[1] << 8;
    switch (type) {
      case 5120:
        return scaled ? std::max(static_cast<std::int8_t>(*data) / 127.f, -1.f) : static_cast<std::int8_t>(*data);
      case 5121:
        return scaled ? *data / 255.f : *data;
      case 5122:
        return scaled ? std::max(static_cast<std::int16_t>(two) / 32767.f, -1.f) : static_cast<std::int16_t>(two);
      case 5123:
        return scaled ? static_cast<float>(two) / 65535.f : static_cast<float>(two);
      case 5125:
        return static_cast<float>(little32(data));
      default:
        return float32(data);
    }
  }

  const Json& document_;
  const std::uint8_t* bytes_;
  std::size_t size_;
  std::string where_;
  double left_;  // numbers
};

}  // namespace detail

// Vertices of one material of a mesh.
struct Primitive {
  std::size_t mesh;
  std::vector<float> positions;       // x y z of each, metres
  std::vector<std::uint32_t> points;  // the point of each; none: the file does not say
  std::vector<float> corners, shares,
      offsets;  // what each lies on: three points, shares of two, x y z from there; none: no other mesh
  std::vector<std::uint32_t> joints;  // `influences` of each
  std::vector<float> weights;
  std::size_t influences = 0;
  std::vector<std::vector<float>> targets;  // x y z of each; an empty one moves none
  std::vector<std::uint32_t> triangles;     // three vertices each

  std::size_t vertices() const { return positions.size() / 3; }
};

struct Target {
  std::string name, shape;                       // an inbetween's shape is another one's
  std::vector<std::pair<double, double>> curve;  // of the shape's weight; none: it is the weight
};

struct HeadMesh {
  std::string name, lies_on;  // another mesh, or none
  std::vector<Target> targets;
};

struct HeadJoint {
  std::string path;
  int parent;                         // -1: none
  detail::Matrix rest, inverse_bind;  // rest is in the space of the parent joint
};

struct Head {
  std::vector<HeadMesh> meshes;
  std::vector<Primitive> primitives;
  std::vector<HeadJoint> joints;  // parents first
};

namespace detail {

class HeadReader {
 public:
  HeadReader(const Json& document, const std::uint8_t* bytes, std::size_t size, std::string where)
      : document_(document), numbers_(document, bytes, size, std::move(where)) {}

  Head head() {
    read_joints();
    const Json& nodes = document_["nodes"];
    std::vector<bool> seen(document_["meshes"].size());
    for (std::size_t i = 0; i < nodes.size(); ++i) {
      if (!nodes.at(i)["mesh"].is_there()) continue;
      const std::size_t number = numbers_.index(nodes.at(i)["mesh"], "mesh");
      if (number >= seen.size() || seen[number]) numbers_.wrong("a mesh that is not there, or at two nodes");
      seen[number] = true;
      read_mesh(document_["meshes"].at(number));
    }
    return std::move(head_);
  }

 private:
  static std::vector<double> floats(const Json& list, std::vector<double> usual) {
    for (std::size_t i = 0; list.size() == usual.size() && i < usual.size(); ++i) usual[i] = list.at(i).number;
    return usual;
  }

  static Matrix local(const Json& node) {
    if (node["matrix"].is_there()) {
      const std::vector<double> m = floats(node["matrix"], std::vector<double>(16));
      return {m[0], m[4], m[8], m[12], m[1], m[5], m[9], m[13], m[2], m[6], m[10], m[14]};
    }
    const std::vector<double> t = floats(node["translation"], {0, 0, 0}), r = floats(node["rotation"], {0, 0, 0, 1}),
                              s = floats(node["scale"], {1, 1, 1});
    return moved(t.data()) * turned(r[0], r[1], r[2], r[3]) * Matrix{s[0], 0, 0, 0, 0, s[1], 0, 0, 0, 0, s[2], 0};
  }

  // Joints in the order of the skin, each below the nearest joint above it. Nodes between are part of its rest.
  void read_joints() {
    const Json &nodes = document_["nodes"], &skin = document_["skins"].at(0), &own = skin["joints"];
    if (document_["skins"].size() > 1) numbers_.wrong("two skins, expected one");
    if (own.size() > kMostJoints || nodes.size() > kMostNodes) numbers_.wrong("more than 1,024 joints or 65,536 nodes");
    if (!own.size()) return;
    std::vector<int> above(nodes.size(), -1), number(nodes.size(), -1);
    for (std::size_t i = 0; i < nodes.size(); ++i)
      for (std::size_t k = 0; k < nodes.at(i)["children"].size(); ++k) {
        const std::size_t child = numbers_.index(nodes.at(i)["children"].at(k), "child");
        if (child >= nodes.size() || above[child] >= 0) numbers_.wrong("a child that is not there, or below two nodes");
        above[child] = static_cast<int>(i);
      }
    const std::vector<float> binds = numbers_.of(skin["inverseBindMatrices"], 16);
    if (binds.size() != 16 * own.size()) numbers_.wrong("not an inverse bind for each joint");
    for (std::size_t j = 0; j < own.size(); ++j) {
      const std::size_t node = numbers_.index(own.at(j), "joint");
      if (node >= nodes.size() || number[node] >= 0) numbers_.wrong("a joint that is not there, or in two places");
      HeadJoint joint{nodes.at(node)["name"].text, -1, local(nodes.at(node)), {}};
      int up = above[node];
      for (std::size_t steps = 0; up >= 0 && number[up] < 0; up = above[up]) {
        if (++steps > nodes.size()) numbers_.wrong("nodes above themselves");
        joint.rest = local(nodes.at(static_cast<std::size_t>(up))) * joint.rest;
      }
      if (up >= 0) {
        joint.parent = number[up];
        joint.path = head_.joints[number[up]].path + "/" + joint.path;
      }
      if (joint.path.size() > kLongestPath) numbers_.wrong("a joint's path of more than 4,096 bytes");
      for (std::size_t row = 0; row < 3; ++row)
        for (std::size_t column = 0; column < 4; ++column)
          joint.inverse_bind[4 * row + column] = binds[16 * j + 4 * column + row];
      number[node] = static_cast<int>(j);
      head_.joints.push_back(std::move(joint));
    }
  }

  void read_mesh(const Json& mesh) {
    const Json &extras = mesh["extras"], &ours = extras["facepipe"], &names = extras["targetNames"];
    HeadMesh made{mesh["name"].text, ours["holds"].text, {}};
    if (std::max({names.size(), ours["inbetweens"].items.size(), ours["curves"].items.size()}) > kMostTargets)
      numbers_.wrong("more than 10,000 morph targets");
    for (std::size_t i = 0; i < names.size(); ++i) {
      Target target{names.at(i).text, names.at(i).text, {}};
      const Json& shape = ours["inbetweens"][target.name.c_str()]["shape"];
      if (shape.is_there()) target.shape = shape.text;
      const Json& curve = ours["curves"][target.name.c_str()];
      for (std::size_t k = 0; k < curve.size(); ++k)
        target.curve.emplace_back(curve.at(k).at(0).number, curve.at(k).at(1).number);
      made.targets.push_back(std::move(target));
    }
    head_.meshes.push_back(std::move(made));
    for (std::size_t i = 0; i < mesh["primitives"].size(); ++i) read_primitive(mesh["primitives"].at(i));
  }

  void read_primitive(const Json& primitive) {
    const Json &attributes = primitive["attributes"], &targets = primitive["targets"];
    Primitive made;
    made.mesh = head_.meshes.size() - 1;
    made.positions = numbers_.of(attributes["POSITION"], 3);
    const std::size_t count = made.vertices();
    const auto fits = [&](std::size_t size, std::size_t width) {
      if (size != count * width) numbers_.wrong("attributes of different lengths");
    };
    if (attributes["_FACEPIPE_POINT"].is_there()) {
      made.points = numbers_.whole(attributes["_FACEPIPE_POINT"], 1, 1u << 24, "points");
      fits(made.points.size(), 1);
    }
    if (attributes["_FACEPIPE_CORNERS"].is_there()) {
      made.corners = numbers_.of(attributes["_FACEPIPE_CORNERS"], 3);
      made.shares = numbers_.of(attributes["_FACEPIPE_SHARES"], 2);
      made.offsets = numbers_.of(attributes["_FACEPIPE_OFFSET"], 3);
      fits(made.corners.size(), 3), fits(made.shares.size(), 2), fits(made.offsets.size(), 3);
    }
    if (!head_.joints.empty()) read_skin(attributes, made);
    if (targets.size() > head_.meshes.back().targets.size()) numbers_.wrong("morph targets without names");
    for (std::size_t i = 0; i < targets.size(); ++i) {
      const bool moves = targets.at(i)["POSITION"].is_there();
      made.targets.push_back(moves ? numbers_.of(targets.at(i)["POSITION"], 3) : std::vector<float>());
      if (moves) fits(made.targets.back().size(), 3);
    }
    made.triangles = numbers_.whole(primitive["indices"], 1, count, "vertices");
    head_.primitives.push_back(std::move(made));
  }

  void read_skin(const Json& attributes, Primitive& made) {
    const std::size_t count = made.vertices(), sets = attributes["JOINTS_1"].is_there() ? 2 : 1;
    made.influences = 4 * sets;
    made.joints.resize(count * made.influences);
    made.weights.resize(count * made.influences);
    for (std::size_t set = 0; set < sets; ++set) {
      const std::vector<std::uint32_t> joints =
          numbers_.whole(attributes[set ? "JOINTS_1" : "JOINTS_0"], 4, head_.joints.size(), "joints");
      const std::vector<float> weights = numbers_.of(attributes[set ? "WEIGHTS_1" : "WEIGHTS_0"], 4);
      if (joints.size() != 4 * count || weights.size() != 4 * count) numbers_.wrong("attributes of different lengths");
      for (std::size_t i = 0; i < 4 * count; ++i) {
        made.joints[i / 4 * made.influences + 4 * set + i % 4] = joints[i];
        made.weights[i / 4 * made.influences + 4 * set + i % 4] = weights[i];
      }
    }
  }

  const Json& document_;
  Numbers numbers_;
  Head head_;
};

}  // namespace detail

// A head, of the bytes of a GLB. Throws Error where it is none, needs an extension to be read, or leaves its bounds.
inline Head read_head(const Bytes& file, const std::string& where) {
  using namespace detail;
  if (file.size() < 20 || std::memcmp(file.data(), "glTF", 4) || little32(file.data() + 4) != 2 ||
      std::memcmp(file.data() + 16, "JSON", 4))
    throw Error(where, "no GLB of version 2");
  const std::size_t size = little32(file.data() + 12);
  if (size > file.size() - 20) throw Error(where, "ends in its JSON");
  const Json document = JsonReader(reinterpret_cast<const char*>(file.data()) + 20, size, where).whole();
  const Json& required = document["extensionsRequired"];
  for (std::size_t i = 0; i < required.size(); ++i)
    if (required.at(i).text != "KHR_mesh_quantization")
      throw Error(where, "needs " + required.at(i).text + ", expected an export that is not compressed");
  const std::size_t start = 20 + size;
  std::size_t bytes = 0;
  if (file.size() - start >= 8 && !std::memcmp(file.data() + start + 4, "BIN\0", 4))
    bytes = little32(file.data() + start);
  if (bytes && bytes > file.size() - start - 8) throw Error(where, "ends in its buffer");
  return HeadReader(document, file.data() + (bytes ? start + 8 : 0), bytes, where).head();
}

// How far a target goes at a weight of its shape: straight lines between knots, whose ends go on.
inline double activation(const Target& target, double weight) {
  const auto& curve = target.curve;
  if (curve.size() < 2) return weight;
  std::size_t i = 0;
  while (i + 2 < curve.size() && weight > curve[i + 1].first) ++i;
  const double span = curve[i + 1].first - curve[i].first;
  return span ? curve[i].second + (curve[i + 1].second - curve[i].second) * (weight - curve[i].first) / span
              : curve[i].second;
}

// Put shapes of a person's lids in place of a head's: points of lids go as they say, and what lies on these goes as
// much farther than in the file.
inline void put_lids_on(Head& head, const Basis& basis, const std::vector<LidShape>& shapes) {
  std::map<std::string, const Mesh*> known;
  for (const Mesh& mesh : basis.meshes) known[mesh.name] = &mesh;
  for (const LidShape& shape : shapes) {
    std::map<std::size_t, std::size_t> numbers;
    const std::vector<std::uint32_t>& lids = basis.lids.eyes[shape.eye].lids;
    for (std::size_t i = 0; i < lids.size(); ++i) numbers[lids[i]] = i;
    std::map<std::size_t, std::array<double, 3>> farther;
    for (const bool lying : {false, true})
      for (Primitive& primitive : head.primitives) {
        const HeadMesh& mesh = head.meshes[primitive.mesh];
        const bool lies = !primitive.corners.empty() && known.count(mesh.lies_on);
        if (lies != lying || (!lies && (primitive.points.empty() || !known.count(mesh.name)))) continue;
        const std::size_t first = known[lies ? mesh.lies_on : mesh.name]->first;
        for (std::size_t t = 0; t < primitive.targets.size(); ++t) {
          const Target& target = mesh.targets[t];
          if (target.shape != shape.name || std::abs(activation(target, shape.weight) - 1) > 1e-6) continue;
          std::vector<float>& offsets = primitive.targets[t];
          offsets.resize(primitive.positions.size());
          for (std::size_t i = 0; i < primitive.vertices(); ++i) {
            float* own = &offsets[3 * i];
            if (!lies) {
              const auto row = numbers.find(first + primitive.points[i]);
              for (std::size_t axis = 0; row != numbers.end() && axis < 3; ++axis) {
                const double value = shape.offsets[3 * row->second + axis] / 1000;
                farther[row->first][axis] = value - own[axis];
                own[axis] = static_cast<float>(value);
              }
              continue;
            }
            const float *corner = &primitive.corners[3 * i], *share = &primitive.shares[2 * i];
            const double shares[3] = {share[0], share[1], 1.0 - share[0] - share[1]};
            for (int k = 0; k < 3; ++k) {
              const auto row = farther.find(first + static_cast<std::size_t>(corner[k]));
              for (std::size_t axis = 0; row != farther.end() && axis < 3; ++axis)
                own[axis] += static_cast<float>(shares[k] * row->second[axis]);
            }
          }
        }
      }
  }
}

// Turn all shapes as a person's, but blinks, looks and squints, which `put_lids_on` fits.
inline void turn_shapes(Head& head, const std::vector<double>& rows, const std::vector<LidShape>& lids) {
  std::set<std::string> fitted;
  for (const LidShape& shape : lids) fitted.insert(shape.name);
  for (Primitive& primitive : head.primitives)
    for (std::size_t t = 0; t < primitive.targets.size(); ++t) {
      if (fitted.count(head.meshes[primitive.mesh].targets[t].shape)) continue;
      std::vector<float>& offsets = primitive.targets[t];
      for (std::size_t i = 0; i < offsets.size(); i += 3) {
        const double x = offsets[i], y = offsets[i + 1], z = offsets[i + 2];
        for (std::size_t k = 0; k < 3; ++k)
          offsets[i + k] = static_cast<float>(rows[3 * k] * x + rows[3 * k + 1] * y + rows[3 * k + 2] * z);
      }
    }
}

// Put a person on a head: positions, how joints rest, shapes, and lids that fit the eyeballs. Returns names of meshes that
// stay as they are, since the file does not say what they go with.
inline std::vector<std::string> put_on(Head& head, const Basis& basis, const Rebuilt& person,
                                       const std::string& where) {
  std::map<std::string, const Mesh*> known;
  for (const Mesh& mesh : basis.meshes) known[mesh.name] = &mesh;
  const auto place = [&](const Mesh& mesh, double point) {
    if (!(point >= 0 && point < mesh.count)) throw Error(where, "a point of " + mesh.name + " that the basis has not");
    return &person.points[3 * (mesh.first + static_cast<std::size_t>(point))];
  };
  std::vector<std::string> left;
  for (Primitive& primitive : head.primitives) {
    const HeadMesh& mesh = head.meshes[primitive.mesh];
    const bool lies = !primitive.corners.empty() && known.count(mesh.lies_on);
    if (!lies && (primitive.points.empty() || !known.count(mesh.name))) {
      if (left.empty() || left.back() != mesh.name) left.push_back(mesh.name);
      continue;
    }
    const Mesh& of = *known[lies ? mesh.lies_on : mesh.name];
    for (std::size_t i = 0; i < primitive.vertices(); ++i) {
      float* position = &primitive.positions[3 * i];
      if (lies) {
        const float *corner = &primitive.corners[3 * i], *share = &primitive.shares[2 * i];
        const double shares[3] = {share[0], share[1], 1.0 - share[0] - share[1]};
        for (int axis = 0; axis < 3; ++axis) {
          double sum = primitive.offsets[3 * i + axis];
          for (int k = 0; k < 3; ++k) sum += shares[k] * place(of, corner[k])[axis] / 1000;
          position[axis] = static_cast<float>(sum);
        }
      } else {
        for (int axis = 0; axis < 3; ++axis)
          position[axis] = static_cast<float>(place(of, primitive.points[i])[axis] / 1000);
      }
    }
  }
  std::map<std::string, std::size_t> places;
  for (std::size_t j = 0; j < basis.joints.size(); ++j) places[basis.joints[j].path] = j;
  for (HeadJoint& joint : head.joints) {
    if (!basis.joints.empty() && !places.count(joint.path))
      throw Error(where, "joint " + joint.path + ", which the basis has not");
    if (basis.joints.empty()) continue;
    const auto world = [&](const HeadJoint& one) {
      const std::size_t number = places[one.path];
      detail::Matrix made;
      for (std::size_t row = 0; row < 3; ++row) {
        std::copy_n(&person.turns[9 * number + 3 * row], 3, &made[4 * row]);
        made[4 * row + 3] = person.joints[3 * number + row] / 1000;
      }
      return made;
    };
    joint.rest = world(joint);
    joint.inverse_bind = detail::turned_back(joint.rest);
    if (joint.parent >= 0) joint.rest = detail::turned_back(world(head.joints[joint.parent])) * joint.rest;
  }
  const std::vector<LidShape> lids = fitted_lids(basis, person, where);
  if (person.shapes != std::vector<double>{1, 0, 0, 0, 1, 0, 0, 0, 1}) turn_shapes(head, person.shapes, lids);
  put_lids_on(head, basis, lids);
  return left;
}

// Skinned vertices, x y z of primitive after primitive in metres: targets first, then linear blend skinning.
// `coefficients` are nine for each joint, as Poses has them, with translations in metres; none: at rest.
inline std::vector<float> skinned(const Head& head, const std::map<std::string, double>& weights,
                                  const std::vector<double>& coefficients) {
  using detail::Matrix;
  std::vector<Matrix> worlds, ways;
  for (std::size_t j = 0; j < head.joints.size(); ++j) {
    const HeadJoint& joint = head.joints[j];
    Matrix world = coefficients.empty() ? joint.rest : joint.rest * detail::posed(&coefficients[9 * j]);
    if (joint.parent >= 0) world = worlds[joint.parent] * world;
    worlds.push_back(world);
    ways.push_back(world * joint.inverse_bind);
  }
  std::vector<float> all;
  for (const Primitive& primitive : head.primitives) {
    std::vector<double> points(primitive.positions.begin(), primitive.positions.end());
    for (std::size_t t = 0; t < primitive.targets.size(); ++t) {
      const Target& target = head.meshes[primitive.mesh].targets[t];
      const auto found = weights.find(target.shape);
      const double amount = found == weights.end() ? 0.0 : activation(target, found->second);
      for (std::size_t i = 0; amount && i < primitive.targets[t].size(); ++i)
        points[i] += amount * primitive.targets[t][i];
    }
    for (std::size_t i = 0; i < primitive.vertices(); ++i) {
      const double* p = &points[3 * i];
      double sum[3] = {p[0], p[1], p[2]};
      if (primitive.influences) sum[0] = sum[1] = sum[2] = 0;
      for (std::size_t k = i * primitive.influences; k < (i + 1) * primitive.influences; ++k) {
        const double weight = primitive.weights[k];
        const Matrix& way = ways[primitive.joints[k]];
        for (std::size_t axis = 0; weight && axis < 3; ++axis)
          sum[axis] +=
              weight * (way[4 * axis] * p[0] + way[4 * axis + 1] * p[1] + way[4 * axis + 2] * p[2] + way[4 * axis + 3]);
      }
      for (double value : sum) all.push_back(static_cast<float>(value));
    }
  }
  return all;
}

}  // namespace facepipe
