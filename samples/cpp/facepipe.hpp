// Persons (.fpb) on their basis (.fpbasis), rebuilt on a device: one header of C++17 without dependencies.
//
// Written from docs/files.md, "A person", "A basis", "Lids", "Bone coefficients". Millimetres, Y is up. Every
// file may be hostile: counts are checked before memory is taken, and whatever is wrong is one Error of one line.
//
//   facepipe::Basis basis = facepipe::read_basis(facepipe::read_file("head.fpbasis"), "head.fpbasis");
//   facepipe::Person person = facepipe::read_person(facepipe::read_file("me.fpb"), "me.fpb");
//   facepipe::Rebuilt face = facepipe::rebuild(basis, person, "me.fpb");
//   for (const facepipe::LidShape& shape : facepipe::fitted_lids(basis, face, "me.fpb")) ...
//
// What it leaves out: SHA-256. The digest in a basis's header is taken as its name; zlib's checksum finds damage.

#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <fstream>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace facepipe {

using Bytes = std::vector<std::uint8_t>;
using Digest = std::array<std::uint8_t, 8>;

// Where, and what was expected, in one line.
struct Error : std::runtime_error {
  Error(const std::string& where, const std::string& what) : std::runtime_error(where + ": " + what) {}
};

constexpr std::uint32_t kMostBody = 1u << 28;    // bytes of a basis
constexpr std::uint32_t kMostPoints = 1u << 20;  // of a basis
constexpr std::uint32_t kFinestGrid = 1000000;   // places in a millimetre
constexpr std::size_t kMostSections = 64;
constexpr std::size_t kMostModes = 4096;
constexpr std::size_t kMostParts = 16;
constexpr int kWhole = 64;                // shares of neighbours are so many-th
constexpr double kLargestWeight = 100.0;  // standard deviations
constexpr double kLargestMove = 1e4;      // millimetres
constexpr double kLargestStep = 10.0;     // millimetres, of identity joints
constexpr int kLargestSteps = 127;        // of each of a joint's numbers
constexpr double kLargestTurn = 0.1;      // radians of a step, of how joints rest
constexpr double kLever = 16.0;           // millimetres: a radian or a factor of theirs counts as that far
constexpr float kFarthest = 1e5f;         // millimetres, of their places
constexpr int kFull = 255;                // of a point's weights, in sum
constexpr double kLargestGrowth = 3.0;    // logarithm of a scale
constexpr double kRoundedTurn = 1.002;    // squares of a half turn in float16
constexpr double kFinerSteps = 1.15;      // of each coarser level
constexpr std::size_t kRings = 13, kMargin = 4;  // of lids, and the last one of the margin
constexpr std::size_t kWays = 7;                 // shapes of lids, eyeLookDown at a half among them
constexpr std::size_t kBands = 16;               // of directions, by their y from -1 to 1

struct Mesh {
  std::string name;
  std::uint32_t first, count;  // of its points among all
};

struct Level {
  std::vector<std::uint32_t> rows;        // points, ascending
  std::uint32_t width = 0;                // neighbours of each
  std::vector<std::uint32_t> neighbours;  // width for each row, the nearest first
  std::vector<std::int8_t> shares;        // 64ths
};

struct Part {
  bool with_modes;                                            // moved after the modes; else it is the mean's
  std::vector<std::pair<std::uint32_t, std::uint32_t>> runs;  // first point, and the one after the last
};

struct Joint {
  std::string path;
  std::vector<std::uint32_t> points;
  std::vector<float> shares;
};

// Joints that are who somebody is: they change the mean face at rest, and pose nothing.
struct IdentityJoints {
  std::size_t first = 0, width = 0;   // point that has some, and how many each has
  std::vector<double> places;         // x y z of each joint, millimetres
  std::vector<std::uint8_t> joints;   // width for each point
  std::vector<std::uint8_t> weights;  // of them, 255ths

  std::size_t count() const { return places.size() / 3; }
};

// An eye; the right one is the mirror image of itself.
struct LidEye {
  std::vector<std::uint32_t> lids, shell;    // points of lids, and of the eyeball's outside
  std::uint32_t first, after;                // points of the eyeball
  std::size_t joints[2];                     // which carry the upper lid and the lower
  std::vector<double> shares;                // of these for each point of lids
  double centre[3];                          // of the mean's eyeball, millimetres
  std::vector<double> balls, stretches;      // of each slider: what the eyeball and the lids' joints do
  std::vector<double> ends, ways;              // of each slider, and of kWays shapes, x y z of each point of lids
  // of the shell in bands of y, by x: direction from the centre, millimetres
  std::array<std::vector<std::array<double, 4>>, kBands> outside;
};

// What blinks, looks and squints are fitted by; without rings there is none of it.
struct Lids {
  std::vector<std::uint8_t> rings, upper;
  std::size_t corners[2] = {}, sliders = 0, cells = 0;
  std::vector<std::uint8_t> links;     // points beside each
  std::vector<std::uint32_t> starts;   // of the rows beside each
  std::vector<std::uint16_t> beside;   // those that are of lids
  std::vector<double> reach;           // cells x cells millimetres
  double farthest = 0;                 // of these
  LidEye eyes[2];
};

struct Basis {
  std::string name;
  Digest digest{};
  std::vector<Mesh> meshes;
  std::vector<double> mean;  // x y z of point after point
  std::vector<std::uint32_t> coarsest;
  std::vector<Level> levels;  // the finer ones
  double step = 0;            // millimetres
  std::size_t mode_count = 0;
  std::vector<std::int16_t> modes;  // steps: mode after mode all x, all y, all z
  std::vector<Part> parts;
  std::vector<Joint> joints;
  IdentityJoints identity;
  Lids lids;

  std::size_t points() const { return mean.size() / 3; }
};

struct Placement {
  double move[3], turn[3], growth;
};

struct Person {
  Digest basis{};
  std::vector<double> modes;     // weights of the first modes
  std::vector<Placement> whole;  // none or one
  std::vector<Placement> parts;  // none or one for each of the basis's
  Bytes points;                  // offsets by levels
  std::vector<int> joints;       // nine numbers of each of the first identity joints, in steps
  double joint_step = 0;         // millimetres
  Placement shapes{};            // offsets of shapes turn and grow by it
  std::vector<double> rests;     // nine coefficients of each of the first joints: to its rest, in millimetres
  Bytes coefficients;            // bone coefficients on top, for read_poses
  std::vector<int> skipped;      // kinds of sections that are there and were left out
};

struct Rebuilt {
  std::vector<double> points;  // x y z of point after point, of all meshes
  std::vector<double> joints;  // x y z of each joint at rest
  std::vector<double> turns;   // nine numbers of each: rows of its rotation; an inverse bind is the inverse of both
  std::vector<double> shapes;  // nine numbers: rows of what offsets of shapes are multiplied by, but those of lids
};

// A shape of a person at a weight, 1 the last, others inbetweens.
struct LidShape {
  std::string name;  // as ARKit has it
  double weight;
  std::size_t eye;              // 0 left, 1 right: whose points of lids `basis.lids` has
  std::vector<double> offsets;  // x y z of each of the eye's points of lids, millimetres
};

namespace detail {

// The band of a direction with that y.
inline std::size_t band_of(double y) {
  return y > -1 ? std::min(static_cast<std::size_t>((y + 1) * (kBands / 2)), kBands - 1) : 0;
}

inline std::uint32_t crc32(const std::uint8_t* data, std::size_t size) {
  static const std::array<std::uint32_t, 256> table = [] {
    std::array<std::uint32_t, 256> made{};
    for (std::uint32_t i = 0; i < 256; ++i) {
      std::uint32_t value = i;
      for (int bit = 0; bit < 8; ++bit) value = value & 1 ? 0xEDB88320u ^ value >> 1 : value >> 1;
      made[i] = value;
    }
    return made;
  }();
  std::uint32_t crc = ~0u;
  for (std::size_t i = 0; i < size; ++i) crc = table[(crc ^ data[i]) & 255] ^ crc >> 8;
  return ~crc;
}

inline std::uint32_t little32(const std::uint8_t* data) {
  return data[0] | data[1] << 8 | data[2] << 16 | static_cast<std::uint32_t>(data[3]) << 24;
}

inline float float32(const std::uint8_t* data) {
  const std::uint32_t bits = little32(data);
  float value;
  std::memcpy(&value, &bits, sizeof value);
  return value;
}

inline double float16(const std::uint8_t* data) {
  const int bits = data[0] | data[1] << 8, exponent = bits >> 10 & 31, fraction = bits & 1023;
  double value = exponent == 31 ? (fraction ? std::nan("") : HUGE_VAL)
                 : exponent     ? std::ldexp(1024 + fraction, exponent - 25)
                                : std::ldexp(fraction, -24);
  return bits >> 15 ? -value : value;
}

// Whether a text is UTF-8: no surrogates, no needless bytes, nothing above U+10FFFF.
inline bool is_utf8(const std::uint8_t* text, std::size_t size) {
  for (std::size_t i = 0; i < size;) {
    const std::uint8_t first = text[i];
    const std::size_t more = first < 0x80   ? 0
                             : first < 0xC2 ? 9
                             : first < 0xE0 ? 1
                             : first < 0xF0 ? 2
                             : first < 0xF5 ? 3
                                            : 9;
    if (more >= size - i) return false;
    for (std::size_t k = 1; k <= more; ++k)
      if ((text[i + k] & 0xC0) != 0x80) return false;
    const std::uint8_t second = more ? text[i + 1] : 0;
    if ((first == 0xE0 && second < 0xA0) || (first == 0xED && second > 0x9F)) return false;
    if ((first == 0xF0 && second < 0x90) || (first == 0xF4 && second > 0x8F)) return false;
    i += more + 1;
  }
  return true;
}

// Bytes one after another, never beyond their end.
class Reader {
 public:
  Reader(const std::uint8_t* data, std::size_t size, std::string where)
      : data_(data), size_(size), where_(std::move(where)) {}

  std::size_t left() const { return size_ - place_; }

  [[noreturn]] void wrong(const std::string& what) const { throw Error(where_, what); }

  const std::uint8_t* take(std::size_t count, std::size_t each = 1) {
    if (each && count > left() / each)
      wrong(std::to_string(size_) + " bytes, expected more after " + std::to_string(place_));
    const std::uint8_t* found = data_ + place_;
    place_ += count * each;
    return found;
  }

  std::uint8_t byte() { return *take(1); }
  std::uint32_t two() {
    const std::uint8_t* found = take(2);
    return found[0] | found[1] << 8;
  }
  std::uint32_t four() { return little32(take(4)); }

  std::string text(std::size_t size) {
    const std::uint8_t* found = take(size);
    if (!is_utf8(found, size)) wrong("a name that is no UTF-8");
    return std::string(found, found + size);
  }

  // Whole numbers of four planes of bytes, folded so that small ones of either sign are small.
  std::vector<std::int64_t> planes(std::size_t count) {
    const std::uint8_t* found = take(count, 4);
    std::vector<std::int64_t> values(count);
    for (std::size_t i = 0; i < count; ++i) {
      const std::uint32_t folded = found[i] | found[i + count] << 8 | found[i + 2 * count] << 16 |
                                   static_cast<std::uint32_t>(found[i + 3 * count]) << 24;
      values[i] = static_cast<std::int64_t>(folded >> 1) ^ -static_cast<std::int64_t>(folded & 1);
    }
    return values;
  }

  void end() const {
    if (left()) wrong(std::to_string(size_) + " bytes, expected " + std::to_string(place_));
  }

 private:
  const std::uint8_t* data_;
  std::size_t size_, place_ = 0;
  std::string where_;
};

// A zlib stream (RFC 1950, 1951), whose codes are looked up by as many bits as the longest has.
class Inflater {
 public:
  Inflater(const std::uint8_t* data, std::size_t size, std::string where)
      : data_(data), size_(size), where_(std::move(where)) {}

  // What the stream is, which must be so many bytes and end where the data ends.
  Bytes inflated(std::size_t size) {
    if (size / 1032 > size_) damaged();  // no stream is worth more
    out_.reserve(size);
    most_ = size;
    const std::uint32_t head = bits(8) << 8, both = head | bits(8);
    if (both % 31 || (both >> 8 & 15) != 8 || both >> 12 > 7 || both & 0x20) damaged();
    for (bool last = false; !last;) {
      last = bits(1);
      block(bits(2));
    }
    bits(held_count_ % 8);
    std::uint32_t low = 1, high = 0, sum = 0;
    for (std::size_t i = 0; i < out_.size();) {
      for (const std::size_t stop = std::min(out_.size(), i + 5552); i < stop; ++i) high += low += out_[i];
      low %= 65521, high %= 65521;
    }
    for (int i = 0; i < 4; ++i) sum = sum << 8 | bits(8);
    if (out_.size() != size || sum != (high << 16 | low) || held_count_ || place_ != size_) damaged();
    return std::move(out_);
  }

 private:
  struct Codes {
    std::vector<std::uint16_t> entries;  // symbol << 4 | bits, by the next bits; 0: no code
    std::uint32_t mask = 0;
  };

  [[noreturn]] void damaged() const { throw Error(where_, "is damaged: not the zlib stream that its header promises"); }

  void fill() {
    for (; held_count_ <= 56 && place_ < size_; held_count_ += 8)
      held_ |= static_cast<std::uint64_t>(data_[place_++]) << held_count_;
  }

  void drop(unsigned count) {
    if (count > held_count_) damaged();
    held_ >>= count;
    held_count_ -= count;
  }

  std::uint32_t bits(unsigned count) {
    fill();
    const std::uint32_t value = static_cast<std::uint32_t>(held_ & ((1ull << count) - 1));
    drop(count);
    return value;
  }

  std::uint32_t symbol(const Codes& codes) {
    fill();
    const std::uint32_t entry = codes.entries[held_ & codes.mask];
    if (!(entry & 15)) damaged();
    drop(entry & 15);
    return entry >> 4;
  }

  // Codes by their lengths. A set that is not full is one code of one bit, or none, as zlib has it.
  Codes codes(const std::uint8_t* lengths, int count, bool whole = false) {
    std::array<int, 16> counts{}, next{};
    for (int i = 0; i < count; ++i) ++counts[lengths[i]];
    int longest = 15, left = 1;
    while (longest && !counts[longest]) --longest;
    for (int length = 1; length <= 15; ++length)
      if ((left = 2 * left - counts[length]) < 0) damaged();
    if (left && (whole || longest > 1)) damaged();
    counts[0] = 0;
    for (int length = 1; length < 16; ++length) next[length] = (next[length - 1] + counts[length - 1]) << 1;
    Codes made;
    made.entries.assign(std::size_t{1} << longest, 0);
    made.mask = (1u << longest) - 1;
    for (int i = 0; i < count; ++i) {
      const int length = lengths[i];
      if (!length) continue;
      std::uint32_t code = static_cast<std::uint32_t>(next[length]++), turned = 0;
      for (int bit = 0; bit < length; ++bit) turned |= (code >> bit & 1) << (length - 1 - bit);
      for (; turned <= made.mask; turned += 1u << length)
        made.entries[turned] = static_cast<std::uint16_t>(i << 4 | length);
    }
    return made;
  }

  void block(std::uint32_t kind) {
    if (kind == 3) damaged();
    if (kind == 0) return stored();
    std::array<std::uint8_t, 320> lengths{};
    int first = 288, second = 32;
    if (kind == 1) {
      for (int i = 0; i < 320; ++i) lengths[i] = i < 144 ? 8 : i < 256 ? 9 : i < 280 ? 7 : i < 288 ? 8 : 5;
    } else {
      read_lengths(lengths, first, second);
    }
    const Codes literals = codes(lengths.data(), first), distances = codes(lengths.data() + first, second);
    for (std::uint32_t next; (next = symbol(literals)) != 256;) {
      if (next < 256) {
        if (out_.size() == most_) damaged();
        out_.push_back(static_cast<std::uint8_t>(next));
      } else {
        copy(next, distances);
      }
    }
  }

  void stored() {
    bits(held_count_ % 8);
    const std::uint32_t length = bits(16), other = bits(16);
    if (length != (other ^ 0xFFFF) || length > most_ - out_.size()) damaged();
    for (std::uint32_t i = 0; i < length; ++i) out_.push_back(static_cast<std::uint8_t>(bits(8)));
  }

  void read_lengths(std::array<std::uint8_t, 320>& lengths, int& first, int& second) {
    static const std::uint8_t order[19] = {16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15};
    first = static_cast<int>(bits(5)) + 257, second = static_cast<int>(bits(5)) + 1;
    const int known = static_cast<int>(bits(4)) + 4;
    if (first > 286 || second > 30) damaged();
    std::uint8_t own[19] = {};
    for (int i = 0; i < known; ++i) own[order[i]] = static_cast<std::uint8_t>(bits(3));
    const Codes meta = codes(own, 19, true);
    for (int i = 0; i < first + second;) {
      const std::uint32_t next = symbol(meta);
      if (next < 16) {
        lengths[i++] = static_cast<std::uint8_t>(next);
        continue;
      }
      if (next == 16 && !i) damaged();
      const std::uint8_t value = next == 16 ? lengths[i - 1] : 0;
      const int times = static_cast<int>(next == 16 ? 3 + bits(2) : next == 17 ? 3 + bits(3) : 11 + bits(7));
      if (i + times > first + second) damaged();
      for (int k = 0; k < times; ++k) lengths[i++] = value;
    }
    if (!lengths[256]) damaged();
  }

  void copy(std::uint32_t symbol_of_length, const Codes& distances) {
    static const std::uint16_t lengths[] = {3,  4,  5,  6,  7,  8,  9,  10, 11,  13,  15,  17,  19,  23, 27,
                                            31, 35, 43, 51, 59, 67, 83, 99, 115, 131, 163, 195, 227, 258};
    static const std::uint16_t places[] = {1,    2,    3,    4,    5,    7,    9,    13,    17,    25,
                                           33,   49,   65,   97,   129,  193,  257,  385,   513,   769,
                                           1025, 1537, 2049, 3073, 4097, 6145, 8193, 12289, 16385, 24577};
    const std::uint32_t which = symbol_of_length - 257;
    if (which > 28) damaged();
    const std::uint32_t length = lengths[which] + (which < 8 || which == 28 ? 0 : bits(which / 4 - 1));
    const std::uint32_t far = symbol(distances);
    if (far > 29) damaged();
    const std::size_t distance = places[far] + (far < 4 ? 0 : bits(far / 2 - 1));
    if (distance > out_.size() || length > most_ - out_.size()) damaged();
    for (std::uint32_t i = 0; i < length; ++i) out_.push_back(out_[out_.size() - distance]);
  }

  const std::uint8_t* data_;
  std::size_t size_, place_ = 0, most_ = 0;
  std::uint64_t held_ = 0;
  unsigned held_count_ = 0;
  std::string where_;
  Bytes out_;
};

struct Section {
  int kind;
  bool required;
  const std::uint8_t* data;
  std::size_t size;
};

// Sections, whose kinds ascend: a kind with 128 more where a reader that does not know it refuses the file, a length in
// groups of 7 bits, bytes.
inline std::vector<Section> sections(const std::uint8_t* data, std::size_t size, const std::string& where) {
  std::vector<Section> found;
  for (std::size_t place = 0; place < size;) {
    const std::string trail = where + " -> section " + std::to_string(found.size() + 1);
    if (found.size() == kMostSections) throw Error(where, "more than 64 sections");
    const int kind = data[place] & 127;
    if (kind <= (found.empty() ? 0 : found.back().kind))
      throw Error(trail, "expected each kind once, ascending from 1");
    const bool required = data[place++] > 127;
    std::uint64_t length = 0;
    for (int group = 0;; ++group) {
      if (group == 5 || place == size || (group && !data[place]))
        throw Error(trail, "a length without end or with needless bytes");
      length |= static_cast<std::uint64_t>(data[place] & 127) << 7 * group;
      if (data[place++] < 128) break;
    }
    if (length > size - place) throw Error(trail, "longer than what follows");
    found.push_back({kind, required, data + place, static_cast<std::size_t>(length)});
    place += static_cast<std::size_t>(length);
  }
  return found;
}

// The body of a basis, section by section.
class BasisReader {
 public:
  BasisReader(const Bytes& body, std::string where) : where_(std::move(where)) {
    for (const Section& one : sections(body.data(), body.size(), where_)) {
      if (one.kind <= 9)
        known_[one.kind] = one;
      else if (one.required)
        throw Error(where_, "section of kind " + std::to_string(one.kind) + ", which this reader does not know");
    }
  }

  Basis basis() {
    Reader name = open(1);
    made_.name = name.text(name.left());
    read_meshes();
    read_mean();
    read_levels();
    if (known_[5].data) read_modes();
    if (known_[6].data) read_parts();
    if (known_[7].data) read_joints();
    if (known_[8].data) read_identity_joints();
    if (known_[9].data) read_lids();
    return std::move(made_);
  }

 private:
  Reader open(int kind) const {
    const std::string trail = where_ + " -> section of kind " + std::to_string(kind);
    if (!known_[kind].data) throw Error(trail, "none, expected one");
    return Reader(known_[kind].data, known_[kind].size, trail);
  }

  void read_meshes() {
    Reader reader = open(2);
    std::uint64_t count = 0;
    while (reader.left()) {
      Mesh mesh{reader.text(reader.byte()), static_cast<std::uint32_t>(count), 0};
      count += mesh.count = reader.four();
      if (count > kMostPoints) break;
      made_.meshes.push_back(std::move(mesh));
    }
    if (!count || count > kMostPoints) reader.wrong(std::to_string(count) + " points, expected 1 to 1048576");
    points_ = static_cast<std::uint32_t>(count);
  }

  void read_mean() {
    Reader reader = open(3);
    reader.take(32);  // of the topology, which a device has no faces to compare with
    const std::uint32_t grid = reader.four();
    if (!grid || grid > kFinestGrid)
      reader.wrong(std::to_string(grid) + " places in a millimetre, expected 1 to 1000000");
    const std::vector<std::int64_t> changes = reader.planes(3 * std::size_t{points_});
    reader.end();
    made_.mean.resize(changes.size());
    for (std::size_t axis = 0; axis < 3; ++axis) {
      std::int64_t place = 0;
      for (std::size_t i = 0; i < points_; ++i) {
        place += changes[axis * points_ + i];
        made_.mean[3 * i + axis] = static_cast<double>(place) / grid;
      }
    }
  }

  void read_levels() {
    Reader reader = open(4);
    const std::size_t count = reader.byte();
    std::vector<std::uint32_t> sizes(count + 1);
    std::uint64_t rows = 0, neighbours = 0;
    for (std::uint32_t& size : sizes) rows += size = reader.four();
    made_.levels.resize(count);
    for (std::size_t i = 0; i < count; ++i)
      neighbours += std::uint64_t{made_.levels[i].width = reader.byte()} * sizes[i + 1];
    if (rows > points_) reader.wrong(std::to_string(rows) + " points of levels, expected at most those of meshes");
    const std::vector<std::int64_t> steps = reader.planes(static_cast<std::size_t>(rows));
    const std::vector<std::int64_t> near = reader.planes(static_cast<std::size_t>(neighbours));
    std::vector<bool> known(points_);
    const std::int64_t* next = steps.data();
    made_.coarsest = ascending(reader, next, sizes[0], known);
    const std::int64_t* away = near.data();
    for (std::size_t i = 0; i < count; ++i) {
      Level& level = made_.levels[i];
      next += sizes[i];
      const std::vector<bool> coarser = known;
      level.rows = ascending(reader, next, sizes[i + 1], known);
      read_neighbours(reader, away, level, coarser);
      away += level.neighbours.size();
    }
    reader.end();
  }

  static std::vector<std::uint32_t> ascending(const Reader& reader, const std::int64_t* steps, std::size_t count,
                                              std::vector<bool>& known) {
    std::vector<std::uint32_t> rows;
    rows.reserve(count);
    std::int64_t row = 0;
    for (std::size_t i = 0; i < count; ++i) {
      row += steps[i];
      if (row < 0 || row >= static_cast<std::int64_t>(known.size()) || (i && steps[i] <= 0) || known[row])
        reader.wrong("points of a level that don't ascend, or are in two, expected each once");
      rows.push_back(static_cast<std::uint32_t>(row));
      known[row] = true;
    }
    if (rows.empty()) reader.wrong("a level without points");
    return rows;
  }

  static void read_neighbours(Reader& reader, const std::int64_t* away, Level& level,
                              const std::vector<bool>& coarser) {
    const std::size_t count = level.rows.size(), width = level.width;
    const std::uint8_t* shares = reader.take(count, width);
    level.neighbours.resize(count * width);
    level.shares.resize(count * width);
    for (std::size_t i = 0; i < count; ++i) {
      int sum = 0;
      for (std::size_t k = 0; k < width; ++k) {
        const std::int64_t near = level.rows[i] + away[k * count + i];
        if (near < 0 || near >= static_cast<std::int64_t>(coarser.size()) || !coarser[near])
          reader.wrong("neighbours that are in no coarser level, expected points that are");
        level.neighbours[i * width + k] = static_cast<std::uint32_t>(near);
        sum += level.shares[i * width + k] = static_cast<std::int8_t>(shares[k * count + i]);
      }
      if (sum != kWhole) reader.wrong("shares of neighbours whose sum is not 64");
    }
  }

  // Each mode's residuals come level by level: what its neighbours' steps predict is added.
  void read_modes() {
    Reader reader = open(5);
    const std::size_t count = reader.two();
    const float step = float32(reader.take(4));
    if (!(step > 0 && step <= 1e3f) || !count) reader.wrong("expected modes in steps above 0, at most 1,000 mm");
    const std::size_t numbers = 3 * count * points_;
    const std::uint8_t* low = reader.take(numbers, 2);
    const std::uint8_t* high = low + numbers;
    reader.end();
    std::vector<bool> known(points_);
    for (std::uint32_t row : made_.coarsest) known[row] = true;
    for (const Level& level : made_.levels)
      for (std::uint32_t row : level.rows) known[row] = true;
    made_.step = step;
    made_.mode_count = count;
    made_.modes.resize(numbers);
    for (std::size_t start = 0; start < numbers; start += points_) {
      std::int16_t* steps = made_.modes.data() + start;
      std::size_t place = start;
      const auto rest = [&] {
        const std::uint32_t folded = low[place] | high[place] << 8;
        ++place;
        return static_cast<int>(folded >> 1) ^ -static_cast<int>(folded & 1);
      };
      for (std::uint32_t row : made_.coarsest) steps[row] = static_cast<std::int16_t>(rest());
      for (const Level& level : made_.levels) {
        const std::uint32_t* near = level.neighbours.data();
        const std::int8_t* share = level.shares.data();
        for (std::uint32_t row : level.rows) {
          int sum = kWhole / 2;
          for (std::uint32_t k = 0; k < level.width; ++k) sum += *share++ * steps[*near++];
          steps[row] = static_cast<std::int16_t>(rest() + (sum >> 6));  // modulo 2^16
        }
      }
      int before = 0;
      for (std::uint32_t row = 0; row < points_; ++row)
        if (!known[row]) steps[row] = static_cast<std::int16_t>(before = static_cast<std::int16_t>(before + rest()));
    }
  }

  void read_parts() {
    Reader reader = open(6);
    while (reader.left()) {
      if (made_.parts.size() == kMostParts) reader.wrong("more than 16 parts");
      const std::uint8_t with_modes = reader.byte();
      const std::size_t count = reader.two();
      const std::uint8_t* runs = reader.take(count, 8);
      Part part{with_modes == 1, {}};
      std::uint32_t after = 0;
      for (std::size_t i = 0; i < count; ++i) {
        const std::uint32_t first = little32(runs + 8 * i), last = little32(runs + 8 * i + 4);
        if (first < after || first >= last || last > points_)
          reader.wrong("runs of a part that don't ascend, or leave the meshes");
        part.runs.emplace_back(first, after = last);
      }
      if (with_modes > 1 || !count) reader.wrong("a part of no kind, or without points");
      made_.parts.push_back(std::move(part));
    }
  }

  void read_joints() {
    Reader reader = open(7);
    while (reader.left()) {
      Joint joint{reader.text(reader.byte()), {}, {}};
      const std::size_t count = reader.byte();
      for (std::size_t i = 0; i < count; ++i) joint.points.push_back(reader.four());
      for (std::size_t i = 0; i < count; ++i) joint.shares.push_back(float32(reader.take(4)));
      for (std::size_t i = 0; i < count; ++i)
        if (joint.points[i] >= points_ || !std::isfinite(joint.shares[i]))
          reader.wrong("a joint of points that are not there");
      if (!count) reader.wrong("a joint of no points");
      made_.joints.push_back(std::move(joint));
    }
  }

  void read_identity_joints() {
    Reader reader = open(8);
    IdentityJoints& own = made_.identity;
    const std::size_t joints = reader.byte(), width = own.width = reader.byte();
    const std::uint64_t first = own.first = reader.four(), count = reader.four();
    if (!joints || !width || !count || first + count > points_) reader.wrong("joints of points that are not there");
    for (std::size_t i = 0; i < 3 * joints; ++i) {
      const float place = float32(reader.take(4));
      if (!(std::abs(place) <= kFarthest)) reader.wrong("places above 100,000 mm, expected smaller ones");
      own.places.push_back(place);
    }
    const std::uint8_t* indices = reader.take(count, width);
    const std::uint8_t* weights = reader.take(count, width);
    reader.end();
    own.joints.resize(count * width);
    own.weights.resize(count * width);
    for (std::size_t i = 0; i < count; ++i) {
      int sum = 0;
      for (std::size_t k = 0; k < width; ++k) {
        if ((own.joints[i * width + k] = indices[k * count + i]) >= joints) reader.wrong("joints that are not there");
        sum += own.weights[i * width + k] = weights[k * count + i];
      }
      if (sum != kFull) reader.wrong("weights of a point whose sum is not 255");
    }
  }

  // Numbers of four planes, as sums of `count` one after another, in millimetres.
  static std::vector<double> sums(Reader& reader, std::size_t count, std::size_t times, double grid) {
    const std::vector<std::int64_t> changes = reader.planes(count * times);
    std::vector<double> found(changes.size());
    std::int64_t place = 0;
    for (std::size_t i = 0; i < found.size(); ++i) {
      place = i % count ? place + changes[i] : changes[i];
      found[i] = static_cast<double>(place) / grid;
      if (!(std::abs(found[i]) <= double{kFarthest})) reader.wrong("lids or eyeballs above 100,000 mm");
    }
    return found;
  }

  // The same of points: all x, then y, then z, as x y z of each.
  static std::vector<double> ways(Reader& reader, std::size_t count, std::size_t times) {
    const std::vector<double> found = sums(reader, count, 3 * times, 100);
    std::vector<double> turned(found.size());
    for (std::size_t i = 0; i < found.size(); ++i)
      turned[i / (3 * count) * 3 * count + i % count * 3 + i / count % 3] = found[i];
    return turned;
  }

  void read_lids() {
    Reader reader = open(9);
    Lids& lids = made_.lids;
    const std::size_t count = reader.two();
    lids.sliders = reader.byte(), lids.cells = reader.two();
    for (std::size_t& corner : lids.corners) corner = reader.two();
    const std::uint8_t* bytes = reader.take(count, 4);
    lids.rings.assign(bytes, bytes + count), lids.upper.assign(bytes + count, bytes + 2 * count);
    lids.links.assign(bytes + 2 * count, bytes + 3 * count);
    bool sides[kRings][2] = {};
    lids.starts.push_back(0);
    for (std::size_t i = 0; i < count; ++i) {
      const std::uint8_t inside = bytes[3 * count + i];
      if (lids.rings[i] >= kRings || lids.upper[i] > 1) reader.wrong("rings of lids that are not there");
      if (inside > lids.links[i] || !lids.links[i]) reader.wrong("points of lids that nothing is beside");
      sides[lids.rings[i]][lids.upper[i]] = true;
      lids.starts.push_back(lids.starts.back() + inside);
    }
    for (std::size_t ring = 0; ring <= kMargin; ++ring)
      if (!sides[ring][0] || !sides[ring][1]) reader.wrong("rings 0 to 4, expected points above and below in each");
    if (std::max(lids.corners[0], lids.corners[1]) >= count || lids.corners[0] == lids.corners[1])
      reader.wrong("corners of an eye that are not there");
    for (std::size_t i = 0; i < lids.starts.back(); ++i) {
      lids.beside.push_back(static_cast<std::uint16_t>(reader.two()));
      if (lids.beside[i] >= count) reader.wrong("points beside others that are not there");
    }
    if (!lids.sliders || lids.cells < 2 || lids.cells > 1024) reader.wrong("expected sliders, and 2 to 1,024 cells");
    lids.reach = sums(reader, lids.cells * lids.cells, 1, 10000);
    lids.farthest = *std::max_element(lids.reach.begin(), lids.reach.end());
    for (int number = 0; number < 2; ++number) read_eye(reader, count, lids.eyes[number], number ? -1.0 : 1.0);
    reader.end();
  }

  void read_eye(Reader& reader, std::size_t count, LidEye& eye, double mirror) {
    eye.first = reader.four(), eye.after = reader.four();
    for (std::size_t& joint : eye.joints) joint = reader.two();
    const std::size_t outside = reader.two(), sliders = made_.lids.sliders;
    const auto points = [&](std::size_t size) {
      const std::uint8_t* found = reader.take(size, 4);
      std::vector<std::uint32_t> rows;
      for (std::size_t i = 0; i < size; ++i) rows.push_back(little32(found + 4 * i));
      return rows;
    };
    eye.lids = points(count), eye.shell = points(outside);
    bool there = eye.first < eye.after && eye.after <= points_ && outside >= 3;
    for (const std::vector<std::uint32_t>* rows : {&eye.lids, &eye.shell})
      for (std::uint32_t row : *rows) there = there && row < points_;
    if (!there || std::max(eye.joints[0], eye.joints[1]) >= made_.joints.size())
      reader.wrong("points or joints of an eye that are not there");
    const std::uint8_t* shares = reader.take(count, 4);
    for (std::size_t i = 0; i < 4 * count; i += 2) eye.shares.push_back((shares[i] | shares[i + 1] << 8) / 65535.0);
    const auto numbers = [&](std::size_t size) {
      std::vector<double> found;
      for (std::size_t i = 0; i < size; ++i) {
        found.push_back(double{float32(reader.take(4))});
        if (!(std::abs(found[i]) <= double{kFarthest})) reader.wrong("an eye above 100,000 mm");
      }
      return found;
    };
    const std::vector<double> centre = numbers(3);
    std::copy(centre.begin(), centre.end(), eye.centre);
    eye.balls = numbers(4 * sliders), eye.stretches = numbers(2 * sliders);
    eye.ends = ways(reader, count, sliders), eye.ways = ways(reader, count, kWays);
    for (std::uint32_t row : eye.shell) {
      double way[3], square = 0;
      for (std::size_t axis = 0; axis < 3; ++axis) {
        way[axis] = (axis ? 1.0 : mirror) * made_.mean[3 * std::size_t{row} + axis] - eye.centre[axis];
        square += way[axis] * way[axis];
      }
      const double length = std::max(std::sqrt(square), 1e-9);
      eye.outside[band_of(way[1] / length)].push_back(
          {way[0] / length, way[1] / length, way[2] / length, length});
    }
    for (auto& band : eye.outside)
      std::stable_sort(band.begin(), band.end(), [](const auto& a, const auto& b) { return a[0] < b[0]; });
  }

  std::string where_;
  Section known_[10] = {};
  std::uint32_t points_ = 0;
  Basis made_;
};

// LZMA's range coder, with probabilities that learn fast at first.
class BitReader {
 public:
  BitReader(const std::uint8_t* data, std::size_t size, std::size_t contexts, std::string where)
      : data_(data), size_(size), likely_(contexts, 1 << 15), shifts_(contexts, 1), where_(std::move(where)) {
    for (int i = 0; i < 4; ++i) code_ = code_ << 8 | next();
  }

  bool bit(std::size_t context) {
    std::uint32_t& likely = likely_[context];
    const std::uint32_t bound = (span_ >> 12) * std::max(likely >> 4, 1u);
    const bool one = code_ >= bound;
    if (one) {
      code_ -= bound;
      span_ -= bound;
      likely -= likely >> shifts_[context];
    } else {
      span_ = bound;
      likely += (65535 - likely) >> shifts_[context];
    }
    if (shifts_[context] < 5) ++shifts_[context];
    fill();
    return one;
  }

  // A number of some bits of even odds.
  int number(int bits) {
    int value = 0;
    for (int i = 0; i < bits; ++i) {
      span_ >>= 1;
      const bool one = code_ >= span_;
      if (one) code_ -= span_;
      value = value << 1 | one;
      fill();
    }
    return value;
  }

  // An Exp-Golomb number.
  int growing() {
    int length = 0;
    while (number(1))
      if (++length > 15) throw Error(where_, "a number of more than 15 bits, expected small ones");
    return (1 << length) - 1 + number(length);
  }

  // A number of 1 or more in six contexts, each a stride from the one before.
  int size(std::size_t context, std::size_t stride) {
    int size = 1;
    while (size < 14 && bit(context + static_cast<std::size_t>(std::min(size, 6) - 1) * stride)) ++size;
    return size == 14 ? size + growing() : size;
  }

 private:
  std::uint32_t next() {  // four zeros at the end may be left out
    if (place_ >= size_ + 4) throw Error(where_, "ends in the middle, expected more bytes");
    const std::size_t place = place_++;
    return place < size_ ? data_[place] : 0;
  }

  void fill() {
    for (; span_ < 1u << 24; span_ <<= 8) code_ = code_ << 8 | next();
  }

  const std::uint8_t* data_;
  std::size_t size_, place_ = 0;
  std::uint32_t code_ = 0, span_ = 0xFFFFFFFF;
  std::vector<std::uint32_t> likely_;
  std::vector<std::uint8_t> shifts_;
  std::string where_;
};

// Offsets of points, level by level, each predicted from its neighbours in coarser ones.
class Offsets {
 public:
  Offsets(const Basis& basis, const Bytes& data, const std::string& where)
      : basis_(basis),
        where_(where),
        bits_(data.data() + std::min<std::size_t>(5, data.size()), data.size() < 5 ? 0 : data.size() - 5,
              1 + 4 + 24 + 24, where),
        steps_(3 * basis.points()),
        got_(3 * basis.points()) {
    if (data.size() < 5) throw Error(where_, "expected at least 5 bytes");
    step_ = float32(data.data());
    sent_ = data[4];
    if (!(step_ > 0 && step_ <= kLargestMove))
      throw Error(where_, "expected steps of more than 0 and at most 10,000 mm");
    if (sent_ > basis.levels.size()) throw Error(where_, "more levels than the basis has");
  }

  const std::vector<double>& all() {
    const Level coarsest{basis_.coarsest, 0, {}, {}};
    read(coarsest, 0);
    for (std::size_t i = 0; i < basis_.levels.size(); ++i) {
      const Level& level = basis_.levels[i];
      predict(level);
      if (i < sent_) read(level, i + 1);
    }
    for (double value : got_)
      if (!(std::abs(value) <= kLargestMove)) throw Error(where_, "offsets above 10,000 mm, expected smaller ones");
    return got_;
  }

 private:
  void predict(const Level& level) {
    const std::uint32_t* near = level.neighbours.data();
    const std::int8_t* share = level.shares.data();
    for (std::uint32_t row : level.rows) {
      double sum[3] = {};
      for (std::uint32_t k = 0; k < level.width; ++k, ++near, ++share)
        for (int axis = 0; axis < 3; ++axis) sum[axis] += *share * got_[3 * std::size_t{*near} + axis];
      for (int axis = 0; axis < 3; ++axis) got_[3 * std::size_t{row} + axis] = sum[axis] / kWhole;
    }
  }

  void read(const Level& level, std::size_t number) {
    if (!bits_.bit(0)) return;
    const double size = step_ * std::pow(kFinerSteps, static_cast<double>(number) - static_cast<double>(sent_));
    for (std::size_t i = 0; i < level.rows.size(); ++i) {
      const std::size_t around = number ? moves_near(level, i) : 3;
      if (!bits_.bit(1 + around)) continue;
      std::size_t before = 0;
      for (std::size_t axis = 0; axis < 3; ++axis) {
        if ((axis < 2 || before) && !bits_.bit(5 + (2 * axis + before) * 4 + around)) continue;
        before = 1;
        const bool negative = bits_.number(1);
        const int count = bits_.size(29 + around, 4);
        const std::size_t place = 3 * std::size_t{level.rows[i]} + axis;
        steps_[place] = count;
        got_[place] += (negative ? -count : count) * size;
      }
    }
  }

  // 0 to 3, by how many steps the four nearest neighbours have.
  std::size_t moves_near(const Level& level, std::size_t row) const {
    std::int64_t total = 0;
    for (std::uint32_t k = 0; k < std::min(level.width, 4u); ++k) {
      const std::size_t place = 3 * std::size_t{level.neighbours[row * level.width + k]};
      total += std::int64_t{steps_[place]} + steps_[place + 1] + steps_[place + 2];
    }
    return total > 3 ? 3 : total > 1 ? 2 : total ? 1 : 0;
  }

  const Basis& basis_;
  std::string where_;
  BitReader bits_;
  double step_ = 0;
  std::size_t sent_ = 0;
  std::vector<int> steps_;   // without signs
  std::vector<double> got_;  // millimetres
};

// Three rows of four, for column vectors.
struct Matrix : std::array<double, 12> {};

inline Matrix moved(const double* to) { return {1, 0, 0, to[0], 0, 1, 0, to[1], 0, 0, 1, to[2]}; }

inline Matrix operator*(const Matrix& a, const Matrix& b) {
  Matrix c{};
  for (std::size_t i = 0; i < 3; ++i) {
    for (std::size_t j = 0; j < 4; ++j)
      c[4 * i + j] = a[4 * i] * b[j] + a[4 * i + 1] * b[4 + j] + a[4 * i + 2] * b[8 + j];
    c[4 * i + 3] += a[4 * i + 3];
  }
  return c;
}

inline Matrix turned(double x, double y, double z, double w) {
  return {1 - 2 * (y * y + z * z), 2 * (x * y - z * w),     2 * (x * z + y * w),     0,
          2 * (x * y + z * w),     1 - 2 * (x * x + z * z), 2 * (y * z - x * w),     0,
          2 * (x * z - y * w),     2 * (y * z + x * w),     1 - 2 * (x * x + y * y), 0};
}

// The inverse of a turn and a move.
inline Matrix turned_back(const Matrix& m) {
  Matrix back{m[0], m[4], m[8], 0, m[1], m[5], m[9], 0, m[2], m[6], m[10], 0};
  for (std::size_t i = 0; i < 12; i += 4)
    back[i + 3] = -(back[i] * m[3] + back[i + 1] * m[7] + back[i + 2] * m[11]);
  return back;
}

// M = T Rz Rx Ry S of nine coefficients.
inline Matrix posed(const double* c) {
  const auto about = [](int axis, double angle) {
    double q[3] = {};
    q[axis] = std::sin(angle / 2);
    return turned(q[0], q[1], q[2], std::cos(angle / 2));
  };
  return moved(c) * about(2, c[5]) * about(0, c[3]) * about(1, c[4]) *
         Matrix{c[6], 0, 0, 0, 0, c[7], 0, 0, 0, 0, c[8], 0};
}

// Points turned and scaled about a point, then moved.
class Similarity {
 public:
  Similarity(const Placement& placement, const double* about) {
    const double* t = placement.turn;
    const double x = t[0], y = t[1], z = t[2], w = std::sqrt(std::max(1 - (x * x + y * y + z * z), 0.0));
    const double length = std::sqrt(x * x + y * y + z * z + w * w), scale = std::exp(placement.growth);
    matrix_ = turned(x / length, y / length, z / length, w / length);
    for (double& number : matrix_) number *= scale;
    for (int i = 0; i < 3; ++i) about_[i] = about[i], matrix_[4 * i + 3] = about[i] + placement.move[i];
  }

  void apply(const double* from, double* to) const {
    const double off[3] = {from[0] - about_[0], from[1] - about_[1], from[2] - about_[2]};
    for (int i = 0; i < 3; ++i)
      to[i] = matrix_[4 * i] * off[0] + matrix_[4 * i + 1] * off[1] + matrix_[4 * i + 2] * off[2] + matrix_[4 * i + 3];
  }

 private:
  Matrix matrix_;
  double about_[3];
};

inline bool is_sound(const Placement& one) {
  double squares = 0;
  bool sound = std::abs(one.growth) <= kLargestGrowth;
  for (int i = 0; i < 3; ++i) {
    squares += one.turn[i] * one.turn[i];
    sound = sound && std::abs(one.move[i]) <= kLargestMove && std::abs(one.turn[i]) <= 1;
  }
  return sound && squares <= kRoundedTurn;
}

inline std::vector<Placement> placements(const Section& section, bool half, bool turned, std::size_t most,
                                         const std::string& where) {
  const std::size_t width = half ? 2 : 4, each = turned ? 7 : 4, count = section.size / (width * each);
  if (section.size % (width * each) || !count || count > most) throw Error(where, "of a size that fits no placements");
  std::vector<Placement> found(count);
  const std::uint8_t* next = section.data;
  for (Placement& one : found) {
    double values[7] = {};
    for (std::size_t i = 0; i < each; ++i, next += width)
      values[turned || i < 3 ? i : 6] = half ? float16(next) : float32(next);
    for (int i = 0; i < 3; ++i) {
      one.move[i] = values[i];
      one.turn[i] = values[3 + i];
    }
    one.growth = values[6];
    if (!is_sound(one)) throw Error(where, "expected a move, part of a quaternion, a scale");
  }
  return found;
}

// Whole numbers of joints, three channels of each kind.
inline std::vector<int> joint_numbers(const std::uint8_t* data, std::size_t size, std::size_t joints,
                                      std::size_t channels, const std::string& where) {
  BitReader bits(data, size, 3 * 7, where);
  std::vector<int> numbers(channels * joints);
  for (std::size_t i = 0; i < numbers.size(); ++i) {
    const std::size_t context = i % channels / 3 * 7;
    if (!bits.bit(context)) continue;
    const bool negative = bits.number(1);
    const int count = bits.size(context + 1, 1);
    if (count > kLargestSteps) throw Error(where, "more than 127 steps, expected fewer");
    numbers[i] = negative ? -count : count;
  }
  return numbers;
}

inline void read_identity(const Section& section, Person& person, const std::string& where) {
  Reader reader(section.data, section.size, where);
  person.joint_step = float16(reader.take(2));
  const std::size_t count = reader.byte();
  if (!(person.joint_step > 0 && person.joint_step <= kLargestStep) || !count)
    reader.wrong("expected joints in steps of more than 0 and at most 10 mm");
  person.joints = joint_numbers(section.data + 3, section.size - 3, count, 9, where);
}

// How joints rest and shapes go, against what points and basis give.
inline void read_rig(const Section& section, Person& person, const std::string& where) {
  Reader reader(section.data, section.size, where);
  const std::uint8_t* head = reader.take(12);
  for (int i = 0; i < 3; ++i) person.shapes.turn[i] = float16(head + 2 * i);
  person.shapes.growth = float16(head + 6);
  const double move = float16(head + 8), turn = float16(head + 10);
  if (!is_sound(person.shapes) || !(move > 0 && move <= kLargestStep && turn > 0 && turn <= kLargestTurn))
    reader.wrong("expected part of a quaternion, a scale, and steps above 0, at most 10 mm and 0.1 radians");
  const std::size_t count = reader.byte();
  const std::vector<int> steps = joint_numbers(section.data + 13, section.size - 13, count, 6, where);
  int turned[3] = {};  // turns are less that of the joint before
  for (std::size_t j = 0; j < count; ++j) {
    for (std::size_t k = 0; k < 3; ++k) person.rests.push_back(move * steps[6 * j + k]);
    for (std::size_t k = 0; k < 3; ++k) person.rests.push_back(turn * (turned[k] += steps[6 * j + 3 + k]));
    person.rests.insert(person.rests.end(), 3, 1.0);
  }
}

// Add what a person's identity joints make of the mean face.
inline void add_joints(const Basis& basis, const Person& person, std::vector<double>& points) {
  const IdentityJoints& own = basis.identity;
  std::vector<Matrix> ways(own.count());  // M - 1 about each joint, a weight's 255th of it; of zeros: at rest
  for (std::size_t j = 0; j < person.joints.size() / 9; ++j) {
    double numbers[9];
    for (std::size_t k = 0; k < 9; ++k)
      numbers[k] = (k > 5 ? 1 : 0) + person.joint_step * person.joints[9 * j + k] / (k < 3 ? 1 : kLever);
    Matrix& way = ways[j] = posed(numbers);
    for (std::size_t i = 0; i < 12; i += 4) {
      way[i + i / 4] -= 1;
      for (std::size_t k = 0; k < 3; ++k) way[i + 3] -= way[i + k] * own.places[3 * j + k];
    }
    for (double& number : way) number /= kFull;
  }
  for (std::size_t at = 0, place = 3 * own.first; at < own.joints.size(); place += 3) {
    Matrix sum{};
    for (const std::size_t end = at + own.width; at < end; ++at) {
      const Matrix& way = ways[own.joints[at]];
      for (std::size_t i = 0; i < 12; ++i) sum[i] += own.weights[at] * way[i];
    }
    const double* from = &basis.mean[place];
    for (std::size_t i = 0; i < 3; ++i)
      points[place + i] += sum[4 * i] * from[0] + sum[4 * i + 1] * from[1] + sum[4 * i + 2] * from[2] + sum[4 * i + 3];
  }
}

}  // namespace detail

// The bytes of a file, 1 GiB at most.
inline Bytes read_file(const std::string& path) {
  std::ifstream file(path, std::ios::binary | std::ios::ate);
  const std::streamoff size = file ? static_cast<std::streamoff>(file.tellg()) : -1;
  if (size < 0 || size > std::streamoff{1} << 30) throw Error(path, "can't be read, expected a file of at most 1 GiB");
  Bytes data(static_cast<std::size_t>(size));
  file.seekg(0);
  if (size && !file.read(reinterpret_cast<char*>(data.data()), size)) throw Error(path, "can't be read");
  return data;
}

// A basis, of the bytes of a .fpbasis. Throws Error where they are none, are damaged, or don't fit each other.
inline Basis read_basis(const Bytes& file, const std::string& where) {
  if (file.size() < 20 || std::memcmp(file.data(), "FPBA", 4))
    throw Error(where, "no basis, expected a file that begins with FPBA");
  if (file[4] != 1 || file[5] || file[6] || file[7]) throw Error(where, "expected version 1 without flags");
  const std::uint32_t size = detail::little32(file.data() + 16);
  if (size > kMostBody) throw Error(where, "expected at most 268435456 bytes of sections");
  const Bytes body = detail::Inflater(file.data() + 20, file.size() - 20, where).inflated(size);
  Basis basis = detail::BasisReader(body, where).basis();
  std::copy_n(file.data() + 8, 8, basis.digest.begin());
  return basis;
}

// A person, of the bytes of a .fpb of version 2. Throws Error where they are none, are damaged, have a section that is
// unknown and required, or numbers beyond limits.
inline Person read_person(const Bytes& file, const std::string& where) {
  using namespace detail;
  if (file.size() < 8 || std::memcmp(file.data(), "FPBC\2\0", 6))
    throw Error(where, "no person, expected a file that begins with FPBC and the version 2");
  const std::size_t end = file.size() - 4;
  if (end < 8 || crc32(file.data(), end) != little32(file.data() + end))
    throw Error(where, "is damaged: its CRC differs");
  if (file[6] || file[7]) throw Error(where, "flags, expected none");
  Person person;
  bool named = false;
  int kind_of_parts = 0;
  for (const Section& one : sections(file.data() + 8, end - 8, where)) {
    if (one.kind == 1) {
      if (one.size != 8) throw Error(where + " -> basis", "expected 8 bytes");
      std::copy_n(one.data, 8, person.basis.begin());
      named = true;
    } else if (one.kind == 2) {
      if (one.size % 2 || !one.size || one.size / 2 > kMostModes)
        throw Error(where + " -> modes", "expected 1 to 4,096 of 2 bytes");
      for (std::size_t i = 0; i < one.size; i += 2) person.modes.push_back(float16(one.data + i));
    } else if (one.kind == 3) {
      person.whole = placements(one, false, true, 1, where + " -> placement");
    } else if (one.kind == 4 || one.kind == 5) {
      if (kind_of_parts) throw Error(where, "parts with turns and without, expected one of them");
      kind_of_parts = one.kind;
      person.parts = placements(one, true, one.kind == 5, kMostParts, where + " -> parts");
    } else if (one.kind == 6) {
      person.points.assign(one.data, one.data + one.size);
    } else if (one.kind == 7) {
      read_identity(one, person, where + " -> joints");
    } else if (one.kind == 12) {
      read_rig(one, person, where + " -> rig");
    } else if (one.required) {
      throw Error(where, "section of kind " + std::to_string(one.kind) + ", which this reader does not know");
    } else {
      if (one.kind == 11) person.coefficients.assign(one.data, one.data + one.size);
      person.skipped.push_back(one.kind);
    }
  }
  if (!named) throw Error(where, "no person: it names no basis");
  for (double weight : person.modes)
    if (!(std::abs(weight) <= kLargestWeight))
      throw Error(where + " -> modes", "expected at most 100 standard deviations");
  return person;
}

// Points of the basis by weights of its first modes.
inline std::vector<double> shaped(const Basis& basis, const std::vector<double>& weights) {
  constexpr std::size_t kBlock = 1024;  // sums that stay in the nearest cache while modes pass
  const std::size_t count = basis.points();
  std::vector<double> points = basis.mean;
  for (std::size_t axis = 0; axis < 3; ++axis) {
    for (std::size_t start = 0; start < count; start += kBlock) {
      double sums[kBlock] = {};
      const std::size_t size = std::min(kBlock, count - start);
      for (std::size_t k = 0; k < weights.size(); ++k) {
        const std::int16_t* steps = basis.modes.data() + (3 * k + axis) * count + start;
        const double weight = basis.step * weights[k];
        for (std::size_t i = 0; i < size; ++i) sums[i] += weight * steps[i];
      }
      for (std::size_t i = 0; i < size; ++i) points[3 * (start + i) + axis] += sums[i];
    }
  }
  return points;
}

// Where the joints of a basis are, x y z of each, by its points.
inline std::vector<double> joint_places(const Basis& basis, const std::vector<double>& points) {
  std::vector<double> places(3 * basis.joints.size());
  for (std::size_t j = 0; j < basis.joints.size(); ++j)
    for (std::size_t i = 0; i < basis.joints[j].points.size(); ++i)
      for (std::size_t axis = 0; axis < 3; ++axis)
        places[3 * j + axis] +=
            double{basis.joints[j].shares[i]} * points[3 * std::size_t{basis.joints[j].points[i]} + axis];
  return places;
}

// Points and joints of a person. Throws Error where it is on another basis, or does not fit it.
inline Rebuilt rebuild(const Basis& basis, const Person& person, const std::string& where) {
  if (person.basis != basis.digest) throw Error(where, "a person on another basis, expected one on " + basis.name);
  if (person.modes.size() > basis.mode_count) throw Error(where, "more modes than its basis has");
  if (!person.parts.empty() && person.parts.size() != basis.parts.size())
    throw Error(where, "not the parts of its basis");
  if (person.joints.size() > 9 * basis.identity.count()) throw Error(where, "more joints than its basis has");
  if (person.rests.size() > 9 * basis.joints.size()) throw Error(where, "more joints at rest than its basis has");
  std::vector<double> points = shaped(basis, person.modes), mean = basis.mean;
  if (!person.joints.empty()) detail::add_joints(basis, person, points);
  const double origin[3] = {};
  for (const Placement& placement : person.whole) {
    const detail::Similarity way(placement, origin);
    for (std::size_t i = 0; i < points.size(); i += 3) {
      way.apply(&points[i], &points[i]);
      way.apply(&mean[i], &mean[i]);
    }
  }
  for (std::size_t p = 0; p < person.parts.size(); ++p) {
    const Part& part = basis.parts[p];
    const std::vector<double>& from = part.with_modes ? points : mean;
    double middle[3] = {}, count = 0;
    for (const auto& [first, after] : part.runs) {
      for (std::size_t i = first; i < after; ++i)
        for (std::size_t axis = 0; axis < 3; ++axis) middle[axis] += from[3 * i + axis];
      count += after - first;
    }
    for (double& value : middle) value /= count;
    const detail::Similarity way(person.parts[p], middle);
    for (const auto& [first, after] : part.runs)
      for (std::size_t i = first; i < after; ++i) way.apply(&from[3 * i], &points[3 * i]);
  }
  if (!person.points.empty()) {
    detail::Offsets offsets(basis, person.points, where + " -> points");
    const std::vector<double>& all = offsets.all();
    for (std::size_t i = 0; i < points.size(); ++i) points[i] += all[i];
  }
  Rebuilt made{std::move(points), {}, {}, std::vector<double>(9)};
  made.joints = joint_places(basis, made.points);
  for (std::size_t j = 0; j < basis.joints.size(); ++j) {
    constexpr double kRest[9] = {0, 0, 0, 0, 0, 0, 1, 1, 1};
    const detail::Matrix way = detail::posed(9 * j < person.rests.size() ? &person.rests[9 * j] : kRest);
    for (std::size_t axis = 0; axis < 3; ++axis) {
      made.joints[3 * j + axis] += way[4 * axis + 3];
      made.turns.insert(made.turns.end(), &way[4 * axis], &way[4 * axis] + 3);
    }
  }
  const detail::Similarity way(person.shapes, origin);
  for (std::size_t k = 0; k < 3; ++k) {
    double axis[3] = {}, to[3];
    axis[k] = 1;
    way.apply(axis, to);
    for (std::size_t i = 0; i < 3; ++i) made.shapes[3 * i + k] = to[i];
  }
  return made;
}

namespace detail {

using Vector = std::array<double, 3>;

inline Vector added(const Vector& a, const Vector& b, double times = 1) {
  return {a[0] + times * b[0], a[1] + times * b[1], a[2] + times * b[2]};
}
inline Vector scaled(double times, const Vector& a) { return {times * a[0], times * a[1], times * a[2]}; }
inline double dot(const Vector& a, const Vector& b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
inline double length(const Vector& a) { return std::sqrt(dot(a, a)); }

// log(1 + e^x)
inline double soft(double x) { return std::max(x, 0.0) + std::log1p(std::exp(-std::abs(x))); }

// Values between known ones at ascending places; beyond these the last.
inline Vector between(double at, const std::vector<double>& places, const std::vector<Vector>& values) {
  const auto beyond = std::upper_bound(places.begin(), places.end(), at);
  const std::size_t next = static_cast<std::size_t>(beyond - places.begin());
  if (!next || next == places.size()) return values[next ? next - 1 : 0];
  const double share = (at - places[next - 1]) / (places[next] - places[next - 1]);
  return added(values[next - 1], added(values[next], values[next - 1], -1), share);
}

// The mean of points and their squares about it, by axes.
struct Spread {
  Vector middle{}, squares{};

  explicit Spread(const std::vector<Vector>& points) {
    for (const Vector& one : points) middle = added(middle, one, 1.0 / static_cast<double>(points.size()));
    for (const Vector& one : points)
      for (std::size_t axis = 0; axis < 3; ++axis)
        squares[axis] += (one[axis] - middle[axis]) * (one[axis] - middle[axis]) / static_cast<double>(points.size());
  }
};

// Lids of an eye that slide over the eyeball: docs/files.md, "Lids". Lengths are millimetres. The right eye is fitted
// as its mirror image.
class EyeFit {
 public:
  using Ways = std::vector<Vector>;

  EyeFit(const Basis& basis, const Rebuilt& person, std::size_t number)
      : tables_(basis.lids),
        eye_(basis.lids.eyes[number]),
        mirror_(number ? -1 : 1),
        ball_(ball(person.points)),
        mean_(ball(basis.mean)) {
    for (std::uint32_t row : eye_.lids) {
      lids_.push_back(place(person.points, row));
      average_.push_back(place(basis.mean, row));
    }
    for (std::size_t i = 0; i < 2; ++i) heights_[i] = person.joints[3 * eye_.joints[i] + 1];
  }

  // How far points of the eyeball are from its middle, of the person and of the mean.
  double size() const { return deviation(ball_); }
  double mean_size() const { return deviation(mean_); }

  // Blinks at a quarter, a half, three quarters and 1, with eyeballs of a scale.
  std::vector<Ways> blinks(double scale) {
    fit_ball(scale);
    const Ways start = lifted(lids_), way = ways(0);
    Ways end = start;
    for (std::size_t i = 0; i < end.size(); ++i) end[i] = added(start[i], way[i]);
    end = lifted(met(lifted(end)));
    std::vector<Ways> found;
    for (double share : {0.25, 0.5, 0.75, 1.0}) {
      found.push_back(share < 1 ? lifted(arced(start, end, share)) : end);
      for (std::size_t i = 0; i < end.size(); ++i) found.back()[i] = added(found.back()[i], start[i], -1);
    }
    return found;
  }

  // Looks up, down at a half, down, in and out, and the squint.
  std::vector<Ways> looks() {
    double sizes[2] = {};
    for (std::size_t axis = 0; axis < 3; ++axis)
      sizes[0] += std::sqrt(ball_.squares[axis]), sizes[1] += std::sqrt(mean_.squares[axis]);
    scale_ = sizes[0] / sizes[1];
    centre_ = added(ball_.middle, added(mean_.middle, centre_of(), -1), -scale_);
    const Turn ahead = turn(0, 0);
    const Ways squint = ways(6);
    std::vector<double> most_of_squint = larger(need(squint, ahead, kOver), need_at_ends(squint, ahead));
    std::vector<Ways> found;
    for (std::size_t look = 0; look < 4; ++look) {
      static constexpr double kAngles[4][2] = {{-0.5, 0}, {0.5, 0}, {0, -0.5}, {0, 0.5}};  // up, down, in, out
      static constexpr std::size_t kOwn[4] = {1, 3, 4, 5};
      const bool has_middle = look == 1;
      const Turn turned = turn(kAngles[look][0], kAngles[look][1]);
      const Turn half = turn(kAngles[look][0] / 2, kAngles[look][1] / 2);
      const Ways own = ways(kOwn[look]);
      Ways middle = has_middle ? ways(2) : own;
      if (!has_middle)
        for (Vector& one : middle) one = scaled(0.5, one);
      std::vector<double> most = larger(need(own, ahead, kOver), need(own, turned, kOver));
      most = larger(most, need_at_ends(own, turned));
      std::vector<double> at_half = need(middle, half, kOver);
      if (!has_middle)
        for (std::size_t i = 0; i < most.size(); ++i) most[i] = std::max(most[i], 2 * at_half[i]);
      const std::vector<double> push = spread(most);
      if (has_middle) {
        for (std::size_t i = 0; i < most.size(); ++i) at_half[i] = std::max(at_half[i], 0.5 * push[i]);
        found.push_back(out(middle, spread(at_half)));
      }
      found.push_back(out(own, push));
      Ways both = squint;
      for (std::size_t i = 0; i < both.size(); ++i) both[i] = added(both[i], found.back()[i]);
      most_of_squint = larger(most_of_squint, need(both, turned, kOverAtEnds));
    }
    found.push_back(out(squint, spread(most_of_squint)));
    return found;
  }

  // Offsets as they are on the side that the eye is.
  std::vector<double> back(const Ways& ways) const {
    std::vector<double> found;
    for (const Vector& one : ways) found.insert(found.end(), {mirror_ * one[0], one[1], one[2]});
    return found;
  }

 private:
  using Turn = std::array<Vector, 3>;

  static constexpr double kFar = -90;       // below all that lies over an eyeball
  static constexpr double kNothing = -1.5;  // less is no push: e^-15
  // by ring: millimetres over the eyeball in a blink, in a look, and at the ends of sliders; of the margin's motion
  static constexpr double kLeast[kRings] = {-1, 0, 0.25, 0.8, 1.4, 1.7, 1.7, 1.7, 1.7, 1.5, 1, -1, -1};
  static constexpr double kOver[kRings] = {kFar, 0, 0.2, 0.6, 1, 1.2, 1.2, 1.2, 1.2, 1.2, 1, kFar, kFar};
  static constexpr double kOverAtEnds[kRings] = {kFar, -1, -0.5, 0.1, 0.2, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3};
  static constexpr double kFollow[kRings] = {0.6, 0.95, 1, 1, 1, 0.95, 0.81, 0.6, 0.42, 0.27, 0.17, 0.09, 0.03};

  Vector place(const std::vector<double>& points, std::size_t row) const {
    return {mirror_ * points[3 * row], points[3 * row + 1], points[3 * row + 2]};
  }

  Spread ball(const std::vector<double>& points) const {
    std::vector<Vector> found;
    for (std::size_t row = eye_.first; row < eye_.after; ++row) found.push_back(place(points, row));
    return Spread(found);
  }

  static double deviation(const Spread& ball) {
    return std::sqrt((ball.squares[0] + ball.squares[1] + ball.squares[2]) / 3);
  }

  Vector centre_of() const { return {eye_.centre[0], eye_.centre[1], eye_.centre[2]}; }

  Ways ways(std::size_t number) const {
    Ways found(lids_.size());
    const double* own = &eye_.ways[3 * number * found.size()];
    for (std::size_t i = 0; i < found.size(); ++i) found[i] = {own[3 * i], own[3 * i + 1], own[3 * i + 2]};
    return found;
  }

  // How far the mean's eyeball reaches in a direction: the mean of the nearest three points of its outside.
  double reach(const Vector& way) const {
    double best[3] = {HUGE_VAL, HUGE_VAL, HUGE_VAL}, radii[3] = {};
    const auto take = [&](const std::array<double, 4>& point) {  // whether nearer ones may follow
      const double x = point[0] - way[0];
      if (!(x * x < best[2])) return false;
      const double y = point[1] - way[1], z = point[2] - way[2], square = x * x + y * y + z * z;
      if (!(square < best[2])) return true;
      int rank = 2;
      for (; rank && square < best[rank - 1]; --rank) best[rank] = best[rank - 1], radii[rank] = radii[rank - 1];
      best[rank] = square, radii[rank] = point[3];
      return true;
    };
    // the direction's band, then one above, one below ... until none on either side can have nearer ones
    const int own = static_cast<int>(band_of(way[1])), all = static_cast<int>(kBands);
    for (int number = 0, shut = 0; number < 2 * all && shut < 2; ++number) {
      const int band = number % 2 ? own + (number + 1) / 2 : own - number / 2;
      const double edge = 2.0 * (number % 2 ? band : band + 1) / all - 1, apart = number ? edge - way[1] : 0;
      if (band < 0 || band >= all || !(apart * apart < best[2])) {
        ++shut;
        continue;
      }
      shut = 0;
      const auto& points = eye_.outside[static_cast<std::size_t>(band)];
      const auto start = std::lower_bound(points.begin(), points.end(), way[0],
                                          [](const std::array<double, 4>& point, double x) { return point[0] < x; });
      for (auto up = start; up != points.end() && take(*up);) ++up;
      for (auto down = start; down != points.begin() && take(*(down - 1));) --down;
    }
    double sum = 0, total = 0;
    for (int i = 0; i < 3; ++i) {
      const double weight = 1 / (std::sqrt(best[i]) + 1e-3);
      sum += weight * radii[i], total += weight;
    }
    return sum / total;
  }

  // How far a point lies over the eyeball, and in which direction.
  double above(const Vector& point, Vector& way) const {
    way = added(point, centre_, -1);
    const double far = length(way);
    way = scaled(1 / far, way);
    return far - scale_ * reach(way);
  }

  Ways lifted(const Ways& lids) const {
    Ways found = lids;
    for (std::size_t i = 0; i < lids.size(); ++i) {
      const double least = kLeast[tables_.rings[i]];
      if (least < 0) continue;
      Vector way;
      const double height = above(lids[i], way);
      found[i] = added(lids[i], way, 0.15 * soft((least - height) / 0.15));
    }
    return found;
  }

  // Move the eyeball a little, so that lids lie on it as the mean's do on theirs: six steps of Gauss and Newton.
  void fit_ball(double scale) {
    std::vector<std::size_t> touching;
    for (std::size_t i = 0; i < lids_.size(); ++i)
      if (tables_.rings[i] == 2 || tables_.rings[i] == 3) touching.push_back(i);
    std::vector<double> goal;
    Vector way;
    centre_ = centre_of(), scale_ = 1;
    for (std::size_t i : touching) goal.push_back(above(average_[i], way));
    const Vector start = added(centre_of(), added(ball_.middle, mean_.middle, -1));
    centre_ = start, scale_ = scale;
    for (int step = 0; step < 6; ++step) {
      const Vector drawn = added(start, centre_, -1);
      double rows[3][4] = {{1, 0, 0, drawn[0]}, {0, 1, 0, drawn[1]}, {0, 0, 1, drawn[2]}};
      for (std::size_t i = 0; i < touching.size(); ++i) {
        const double miss = above(lids_[touching[i]], way) - goal[i], square = miss < 0 ? 9 : 1;
        for (std::size_t a = 0; a < 3; ++a) {
          for (std::size_t b = 0; b < 3; ++b) rows[a][b] += square * way[a] * way[b];
          rows[a][3] += square * way[a] * miss;
        }
      }
      centre_ = added(centre_, solved(rows));
    }
  }

  // Of a symmetric positive definite matrix and a column beside it.
  static Vector solved(double (&rows)[3][4]) {
    for (int i = 0; i < 3; ++i)
      for (int k = i + 1; k < 3; ++k)
        for (int column = 3; column >= i; --column) rows[k][column] -= rows[k][i] / rows[i][i] * rows[i][column];
    Vector found{};
    for (int i = 2; i >= 0; --i) {
      double sum = rows[i][3];
      for (int k = i + 1; k < 3; ++k) sum -= rows[i][k] * found[static_cast<std::size_t>(k)];
      found[static_cast<std::size_t>(i)] = sum / rows[i][i];
    }
    return found;
  }

  // Lids with the upper margin brought onto the lower one, and the lid drawn after it.
  Ways met(const Ways& lids) const {
    const Vector inner = lids[tables_.corners[0]], across = added(lids[tables_.corners[1]], inner, -1);
    const Vector axis = scaled(1 / dot(across, across), across);
    Vector down = {axis[1], -axis[0], 0};
    down = scaled((down[1] > 0 ? -1 : 1) / length(down), down);
    std::vector<double> along;
    for (const Vector& one : lids) {
      along.push_back(dot(added(one, inner, -1), axis));
      if (!std::isfinite(along.back())) throw Error("lids", "an eye without width, expected corners that are apart");
    }
    Ways found = lids;
    for (std::size_t ring = 0; ring < kRings; ++ring) {
      std::vector<std::size_t> upper = rows(std::min(ring, kMargin), 1), lower = rows(std::min(ring, kMargin), 0);
      std::vector<double> at[2];
      Ways goals, moves;
      for (std::vector<std::size_t>* side : {&upper, &lower}) {
        std::stable_sort(side->begin(), side->end(), [&](std::size_t a, std::size_t b) { return along[a] < along[b]; });
        for (std::size_t i : *side) at[side == &lower].push_back(along[i]);
      }
      for (std::size_t i : lower) goals.push_back(lids[i]);
      for (std::size_t i : upper) {
        const double end = std::min(along[i] - at[1].front(), at[1].back() - along[i]);
        const double taper = std::min(std::max(end / 0.04, 0.0), 1.0);
        const Vector way = scaled(taper, added(between(along[i], at[1], goals), lids[i], -1));
        moves.push_back(added(added(way, down, 0.4 * taper), across, -dot(way, axis)));
      }
      for (std::size_t i : ring <= kMargin ? upper : rows(ring, 1))
        found[i] = added(found[i], between(along[i], at[0], moves), kFollow[ring]);
    }
    return found;
  }

  std::vector<std::size_t> rows(std::size_t ring, int upper) const {
    std::vector<std::size_t> found;
    for (std::size_t i = 0; i < lids_.size(); ++i)
      if (tables_.rings[i] == ring && tables_.upper[i] == upper) found.push_back(i);
    return found;
  }

  // Points a share of their way on arcs around the eyeball's middle.
  Ways arced(const Ways& start, const Ways& end, double share) const {
    Ways found;
    for (std::size_t i = 0; i < start.size(); ++i) {
      const Vector from = added(start[i], centre_, -1), to = added(end[i], centre_, -1);
      const double first = length(from), last = length(to);
      const Vector a = scaled(1 / first, from), b = scaled(1 / last, to);
      const Vector cross = {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
      const double angle = std::max(std::atan2(length(cross), dot(a, b)), 1e-6);
      const double far = ((1 - share) * first + share * last) / std::sin(angle);
      found.push_back(added(added(centre_, a, far * std::sin((1 - share) * angle)), b, far * std::sin(share * angle)));
    }
    return found;
  }

  static Turn turn(double x, double y) {  // about x, after that about y
    const double a = std::cos(x), b = std::sin(x), c = std::cos(y), d = std::sin(y);
    return {Vector{c, 0, d}, Vector{b * d, a, -b * c}, Vector{-a * d, b, a * c}};
  }

  // How far an offset from the middle of a turned eyeball of a scale lacks to lie over it.
  double lack(const Vector& offset, const Turn& turn, double scale, double least) const {
    const double far = length(offset);
    double way[3], where[2];
    for (std::size_t axis = 0; axis < 3; ++axis)
      way[axis] = offset[0] * turn[0][axis] + offset[1] * turn[1][axis] + offset[2] * turn[2][axis];
    const std::size_t cells = tables_.cells;
    const double most = static_cast<double>(cells) - 1, flat = 1 / (far + std::max(way[2], -0.5 * far));
    for (int axis = 0; axis < 2; ++axis)
      where[axis] = std::min(std::max(0.0, (way[axis] * flat + 1.5) * (most / 3)), most - 0.001);
    const std::size_t column = static_cast<std::size_t>(where[0]), row = static_cast<std::size_t>(where[1]);
    const double s = where[0] - static_cast<double>(column), t = where[1] - static_cast<double>(row);
    const double *low = &tables_.reach[row * cells + column], *high = low + cells;
    return least + scale * ((1 - t) * ((1 - s) * low[0] + s * low[1]) + t * ((1 - s) * high[0] + s * high[1])) - far;
  }

  std::vector<double> need(const Ways& ways, const Turn& turn, const double (&least)[kRings]) const {
    std::vector<double> found(ways.size());
    for (std::size_t i = 0; i < ways.size(); ++i)
      found[i] = lack(added(added(lids_[i], ways[i]), centre_, -1), turn, scale_, least[tables_.rings[i]]);
    return found;
  }

  // The most that lids lack at an end of a slider. What lies as far above as no eyeball reaches is not looked up.
  std::vector<double> need_at_ends(const Ways& ways, const Turn& turn) const {
    std::vector<double> found(ways.size(), kNothing);
    for (std::size_t slider = 0; slider < 2 * tables_.sliders; ++slider) {
      const double sign = slider % 2 ? 1 : -1;
      const double *ball = &eye_.balls[slider / 2 * 4], *stretch = &eye_.stretches[slider / 2 * 2];
      const double* ends = &eye_.ends[slider / 2 * 3 * ways.size()];
      const Vector middle = added(centre_, Vector{ball[0], ball[1], ball[2]}, sign);
      for (std::size_t i = 0; i < ways.size(); ++i) {
        Vector moved = added(added(lids_[i], ways[i]), Vector{ends[3 * i], ends[3 * i + 1], ends[3 * i + 2]}, sign);
        const double height = moved[1];
        for (std::size_t lid = 0; lid < 2; ++lid)
          moved[1] += eye_.shares[lid * ways.size() + i] * sign * (stretch[0] + stretch[1] * (height - heights_[lid]));
        const double least = kOverAtEnds[tables_.rings[i]], scale = scale_ * (1 + sign * ball[3]);
        const Vector offset = added(moved, middle, -1);
        const double far = least + scale * tables_.farthest - found[i];
        if (far > 0 && dot(offset, offset) < far * far) found[i] = std::max(found[i], lack(offset, turn, scale, least));
      }
    }
    return found;
  }

  static std::vector<double> larger(std::vector<double> one, const std::vector<double>& other) {
    for (std::size_t i = 0; i < one.size(); ++i) one[i] = std::max(one[i], other[i]);
    return one;
  }

  // Pushes of at least the need, as smooth as a skin drawn over them.
  std::vector<double> spread(const std::vector<double>& need) const {
    std::vector<double> least;
    for (double one : need) least.push_back(0.1 * soft(one / 0.1));
    std::vector<double> push = least, next = least;
    for (int round = 0; round < 12; ++round) {
      for (std::size_t i = 0; i < push.size(); ++i) {
        double sum = 0;
        for (std::size_t k = tables_.starts[i]; k < tables_.starts[i + 1]; ++k) sum += push[tables_.beside[k]];
        next[i] = std::max(least[i], sum / tables_.links[i]);
      }
      push.swap(next);
    }
    return push;
  }

  Ways out(const Ways& ways, const std::vector<double>& push) const {
    Ways found = ways;
    for (std::size_t i = 0; i < ways.size(); ++i) {
      const Vector offset = added(added(lids_[i], ways[i]), centre_, -1);
      found[i] = added(ways[i], offset, push[i] / length(offset));
    }
    return found;
  }

  const Lids& tables_;
  const LidEye& eye_;
  const double mirror_;
  Spread ball_, mean_;
  Ways lids_, average_;
  double heights_[2];
  Vector centre_{};
  double scale_ = 1;
};

}  // namespace detail

// Blinks, looks and squints that fit a person's eyeballs, in place of those of the head that everyone has. None where
// the basis has no tables of lids. Throws Error where an eye has no width.
inline std::vector<LidShape> fitted_lids(const Basis& basis, const Rebuilt& person, const std::string& where) {
  std::vector<LidShape> found;
  if (basis.lids.rings.empty()) return found;
  detail::EyeFit eyes[2] = {{basis, person, 0}, {basis, person, 1}};
  const double scale = (eyes[0].size() + eyes[1].size()) / (eyes[0].mean_size() + eyes[1].mean_size());
  for (std::size_t number = 0; number < 2; ++number) {
    static const std::pair<const char*, double> kShapes[] = {
        {"eyeBlink", 0.25}, {"eyeBlink", 0.5},    {"eyeBlink", 0.75}, {"eyeBlink", 1},   {"eyeLookUp", 1},
        {"eyeLookDown", 0.5}, {"eyeLookDown", 1}, {"eyeLookIn", 1},   {"eyeLookOut", 1}, {"eyeSquint", 1}};
    std::vector<detail::EyeFit::Ways> ways;
    try {
      ways = eyes[number].blinks(scale);
    } catch (const Error& error) {
      throw Error(where, error.what());
    }
    for (detail::EyeFit::Ways& one : eyes[number].looks()) ways.push_back(std::move(one));
    for (std::size_t i = 0; i < ways.size(); ++i)
      found.push_back({std::string(kShapes[i].first) + (number ? "Right" : "Left"), kShapes[i].second, number,
                       eyes[number].back(ways[i])});
  }
  return found;
}

// Bone coefficients: of m joints in each of T frames, relative to rest.
struct Poses {
  std::size_t joints = 0, frames = 0;
  double meters_per_unit = 0;  // of translations
  Digest joints_hash{};        // of the skeleton's paths, which a device compares with what `apply-bones --info` prints
  std::vector<float> times;    // seconds; none: poses
  std::vector<double> values;  // T m 9: tx ty tz rx ry rz sx sy sz, at rest 0 0 0 0 0 0 1 1 1
};

// Bone coefficients, of the bytes of a .fpb of version 1.
inline Poses read_poses(const Bytes& file, const std::string& where) {
  using namespace detail;
  if (file.size() < 36 || std::memcmp(file.data(), "FPBC\1\0", 6))
    throw Error(where, "no bone coefficients, expected FPBC and the version 1");
  const std::uint8_t* data = file.data();
  const std::uint32_t flags = data[6] | data[7] << 8, m = little32(data + 8), frames = little32(data + 12),
                      stored = little32(data + 16);
  const bool wide = flags & 1, timed = flags & 4, sparse = flags & 8;
  if (flags > 15 || (timed && !(flags & 2))) throw Error(where, "flags that don't fit each other");
  if (!frames || (!(flags & 2) && frames > 1) || !stored || stored > m || (!sparse && stored < m))
    throw Error(where, "counts that don't fit each other");
  const double numbers = 9.0 * frames * m, kept = 9.0 * frames * stored;  // beyond 2^53 they are refused anyway
  const double size = 32.0 + (timed ? 4.0 * frames : 0.0) + (wide ? 4 : 2) * kept + (sparse ? (m + 7.0) / 8 : 0.0) + 4;
  if (std::floor(size) != static_cast<double>(file.size()) || numbers > std::min(134217728.0, 8388608 + 32 * kept))
    throw Error(where, "not the size that its header counts");
  const std::size_t end = file.size() - 4;
  if (crc32(data, end) != little32(data + end)) throw Error(where, "is damaged: its CRC differs");
  Poses poses;
  poses.joints = m, poses.frames = frames, poses.meters_per_unit = float32(data + 20);
  if (!(poses.meters_per_unit >= 1e-9 && poses.meters_per_unit <= 1e9))
    throw Error(where, "expected metres in a unit above 0");
  std::copy_n(data + 24, 8, poses.joints_hash.begin());
  const std::uint8_t* next = data + 32;
  for (std::uint32_t i = 0; timed && i < frames; ++i, next += 4) {
    poses.times.push_back(float32(next));
    if (!std::isfinite(poses.times[i]) || (i && poses.times[i] <= poses.times[i - 1]))
      throw Error(where, "times that don't ascend");
  }
  const std::uint8_t* mask = next + static_cast<std::size_t>(kept) * (wide ? 4 : 2);
  std::vector<std::size_t> places;
  for (std::size_t j = 0; j < (sparse ? (m + std::size_t{7}) / 8 * 8 : m); ++j)
    if (!sparse || mask[j / 8] >> j % 8 & 1) places.push_back(j);
  if (places.size() != stored || places.back() >= m) throw Error(where, "a joint mask that does not fit its count");
  poses.values.assign(static_cast<std::size_t>(numbers), 0.0);
  for (std::size_t i = 6; i < poses.values.size(); i += i % 9 == 8 ? 7 : 1) poses.values[i] = 1;
  for (std::size_t frame = 0; frame < frames; ++frame)
    for (std::size_t place : places)
      for (std::size_t k = 0; k < 9; ++k, next += wide ? 4 : 2) {
        const double value = wide ? float32(next) : float16(next);
        if (!(std::abs(value) <= 0x1p100)) throw Error(where, "NaN, infinity or a number above 2^100");
        poses.values[(frame * m + place) * 9 + k] += value;
      }
  return poses;
}

}  // namespace facepipe
