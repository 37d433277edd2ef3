// Persons (.fpb) on their basis (.fpbasis), rebuilt on a device: one file of C# 7.3 without unsafe code or packages,
// for Unity and others.
//
// Written from docs/files.md, "A person" and "A basis". Lengths are millimetres, Y is up, axes are right-handed:
// Unity's x is the negative of this one. Every file may be hostile: counts are checked before memory is taken, and
// whatever is wrong is one FacepipeException of one line.
//
//   var basis = Facepipe.Basis.Read(File.ReadAllBytes("head.fpbasis"), "head.fpbasis");
//   var person = Facepipe.Person.Read(File.ReadAllBytes("me.fpb"), "me.fpb");
//   Facepipe.Rebuilt face = basis.Rebuild(person, "me.fpb");
//
// What it leaves out: SHA-256. The digest in a basis's header is taken as its name; zlib's checksum finds damage.

using System;
using System.Collections.Generic;
using System.Text;

namespace Facepipe
{
    /// <summary>Where, and what was expected, in one line.</summary>
    public sealed class FacepipeException : Exception
    {
        public FacepipeException(string where, string what) : base(where + ": " + what) { }
    }

    /// <summary>A mesh, whose points follow those of the mesh before.</summary>
    public sealed class Mesh
    {
        public string Name;
        public int First, Count; // of its points among all
    }

    /// <summary>Points of a level, and of which of coarser levels they are predicted.</summary>
    public sealed class Level
    {
        public int[] Rows; // ascending
        public int Width; // neighbours of each
        public int[] Neighbours; // Width for each row, the nearest first
        public sbyte[] Shares; // 64ths
    }

    /// <summary>Points that keep their shape, or that of their modes.</summary>
    public sealed class Part
    {
        public bool WithModes; // moved after the modes; else it is the mean's
        public int[] Runs; // first point, and the one after the last, of each run
    }

    /// <summary>A joint, which is where a weighted mean of points is.</summary>
    public sealed class Joint
    {
        public string Path;
        public int[] Points;
        public float[] Shares;
    }

    /// <summary>Joints that are who somebody is: they change the mean face at rest, and pose nothing.</summary>
    public sealed class IdentityJoints
    {
        public int First, Width; // point that has some, and how many each has
        public float[] Places = new float[0]; // x y z of each joint, millimetres
        public byte[] Joints = new byte[0]; // Width for each point
        public byte[] Weights = new byte[0]; // of them, 255ths

        public int Count { get { return Places.Length / 3; } }
    }

    /// <summary>What a person is, in millimetres.</summary>
    public sealed class Rebuilt
    {
        public double[] Points; // x y z of point after point, of all meshes
        public double[] Joints; // x y z of each joint: inverse binds are translations by the negative of it
    }

    /// <summary>Where a whole or a part lies.</summary>
    public sealed class Placement
    {
        public readonly double[] Move = new double[3], Turn = new double[3];
        public double Growth; // logarithm of the scale
    }

    static class Limits
    {
        public const int Body = 1 << 28, Points = 1 << 20, Grid = 1000000; // bytes, points, places in a millimetre
        public const int Sections = 64, Modes = 4096, Parts = 16, Whole = 64;
        public const int Steps = 127, Full = 255; // of a number of identity joints, and of a point's weights in sum
        public const double Step = 10, Farthest = 1e5; // millimetres, of identity joints
        public const double Weight = 100, Move = 1e4, Growth = 3, Turn = 1.002; // half turns round in float16
    }

    struct Section
    {
        public int Kind, Start, Size;
        public bool Required;

        // Sections, whose kinds ascend: a kind with 128 more where a reader that does not know it refuses the file, a
        // length in groups of 7 bits, bytes.
        public static List<Section> All(byte[] data, int place, int end, string where)
        {
            var found = new List<Section>();
            while (place < end)
            {
                string trail = where + " -> section " + (found.Count + 1);
                if (found.Count == Limits.Sections) throw new FacepipeException(where, "more than 64 sections");
                var one = new Section { Kind = data[place] & 127, Required = data[place] > 127 };
                if (one.Kind <= (found.Count == 0 ? 0 : found[found.Count - 1].Kind))
                    throw new FacepipeException(trail, "expected each kind once, ascending from 1");
                long length = 0;
                place++;
                for (int group = 0; ; group++)
                {
                    if (group == 5 || place == end || (group > 0 && data[place] == 0))
                        throw new FacepipeException(trail, "a length without end or with needless bytes");
                    length |= (long)(data[place] & 127) << 7 * group;
                    if (data[place++] < 128) break;
                }
                if (length > end - place) throw new FacepipeException(trail, "longer than what follows");
                one.Start = place;
                one.Size = (int)length;
                found.Add(one);
                place += one.Size;
            }
            return found;
        }
    }

    // Bytes one after another, never beyond their end.
    sealed class Reader
    {
        static readonly UTF8Encoding Utf8 = new UTF8Encoding(false, true);
        readonly byte[] data;
        readonly int start, end;
        readonly string where;
        int place;

        public Reader(byte[] data, int start, int size, string where)
        {
            this.data = data;
            this.start = place = start;
            this.where = where;
            end = start + size;
        }

        public int Left { get { return end - place; } }

        public FacepipeException Wrong(string what) { return new FacepipeException(where, what); }

        // The place of so many bytes.
        public int Take(long count)
        {
            if (count > Left) throw Wrong((end - start) + " bytes, expected more after " + (place - start));
            place += (int)count;
            return place - (int)count;
        }

        public int Byte() { return data[Take(1)]; }

        public int Two()
        {
            int at = Take(2);
            return data[at] | data[at + 1] << 8;
        }

        public uint Four() { return Numbers.Little32(data, Take(4)); }

        public float Single() { return BitConverter.ToSingle(data, Take(4)); }

        public string Text(int size)
        {
            int at = Take(size);
            try
            {
                return Utf8.GetString(data, at, size);
            }
            catch (ArgumentException)
            {
                throw Wrong("a name that is no UTF-8");
            }
        }

        // Whole numbers of four planes of bytes, folded so that small ones of either sign are small.
        public long[] Planes(long count)
        {
            int at = Take(4 * count), size = (int)count;
            var values = new long[size];
            for (int i = 0; i < size; i++, at++)
            {
                int low = data[at] | data[at + size] << 8, high = data[at + 2 * size] | data[at + 3 * size] << 8;
                long folded = (uint)(low | high << 16);
                values[i] = (folded >> 1) ^ -(folded & 1);
            }
            return values;
        }

        public void End()
        {
            if (Left > 0) throw Wrong((end - start) + " bytes, expected " + (place - start));
        }
    }

    static class Numbers
    {
        static readonly uint[] Table = CrcTable();

        static uint[] CrcTable()
        {
            var table = new uint[256];
            for (uint i = 0; i < 256; i++)
            {
                uint value = i;
                for (int bit = 0; bit < 8; bit++) value = (value & 1) != 0 ? 0xEDB88320u ^ value >> 1 : value >> 1;
                table[i] = value;
            }
            return table;
        }

        public static uint Crc32(byte[] data, int size)
        {
            uint crc = uint.MaxValue;
            for (int i = 0; i < size; i++) crc = Table[(crc ^ data[i]) & 255] ^ crc >> 8;
            return ~crc;
        }

        public static uint Little32(byte[] data, int at)
        {
            return (uint)(data[at] | data[at + 1] << 8 | data[at + 2] << 16 | data[at + 3] << 24);
        }

        public static double Half(byte[] data, int at)
        {
            int bits = data[at] | data[at + 1] << 8, exponent = bits >> 10 & 31, fraction = bits & 1023;
            double value = exponent == 31 ? (fraction != 0 ? double.NaN : double.PositiveInfinity)
                : exponent != 0 ? (1024 + fraction) * Math.Pow(2, exponent - 25)
                : fraction * Math.Pow(2, -24);
            return bits >> 15 != 0 ? -value : value;
        }

        public static bool AreBytes(byte[] data, params byte[] expected)
        {
            for (int i = 0; i < expected.Length; i++)
                if (i >= data.Length || data[i] != expected[i]) return false;
            return true;
        }
    }

    // A zlib stream (RFC 1950, 1951), whose codes are looked up by as many bits as the longest has. DeflateStream does
    // not say where a stream ends, nor check its sum.
    sealed class Inflater
    {
        static readonly int[] Order = { 16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15 };
        static readonly int[] Lengths =
        {
            3, 4, 5, 6, 7, 8, 9, 10, 11, 13, 15, 17, 19, 23, 27, 31, 35, 43, 51, 59, 67, 83, 99, 115, 131, 163, 195,
            227, 258
        };
        static readonly int[] Distances =
        {
            1, 2, 3, 4, 5, 7, 9, 13, 17, 25, 33, 49, 65, 97, 129, 193, 257, 385, 513, 769, 1025, 1537, 2049, 3073, 4097,
            6145, 8193, 12289, 16385, 24577
        };

        readonly byte[] data;
        readonly string where;
        byte[] made;
        int place, count, heldCount;
        ulong held;

        public Inflater(byte[] data, int place, string where)
        {
            this.data = data;
            this.place = place;
            this.where = where;
        }

        // What the stream is, which must be so many bytes and end where the data ends.
        public byte[] Inflated(int size)
        {
            if (size / 1032 > data.Length) throw Damaged(); // no stream is worth more
            made = new byte[size];
            int head = Bits(8) << 8 | Bits(8);
            if (head % 31 != 0 || (head >> 8 & 15) != 8 || head >> 12 > 7 || (head & 0x20) != 0) throw Damaged();
            for (bool last = false; !last;)
            {
                last = Bits(1) == 1;
                Block(Bits(2));
            }
            Bits(heldCount % 8);
            uint low = 1, high = 0, sum = 0;
            for (int i = 0; i < count;)
            {
                for (int stop = Math.Min(count, i + 5552); i < stop; i++) high += low += made[i];
                low %= 65521;
                high %= 65521;
            }
            for (int i = 0; i < 4; i++) sum = sum << 8 | (uint)Bits(8);
            if (count != size || sum != (high << 16 | low) || heldCount != 0 || place != data.Length) throw Damaged();
            return made;
        }

        FacepipeException Damaged()
        {
            return new FacepipeException(where, "is damaged: not the zlib stream that its header promises");
        }

        void Fill()
        {
            for (; heldCount <= 56 && place < data.Length; heldCount += 8) held |= (ulong)data[place++] << heldCount;
        }

        void Drop(int bits)
        {
            if (bits > heldCount) throw Damaged();
            held >>= bits;
            heldCount -= bits;
        }

        int Bits(int bits)
        {
            Fill();
            int value = (int)(held & ((1ul << bits) - 1));
            Drop(bits);
            return value;
        }

        int Symbol(ushort[] codes)
        {
            Fill();
            int entry = codes[(int)held & (codes.Length - 1)];
            if ((entry & 15) == 0) throw Damaged();
            Drop(entry & 15);
            return entry >> 4;
        }

        // Codes by their lengths: symbol << 4 | bits, by the next bits; 0: no code. A set that is not full is one code
        // of one bit, or none, as zlib has it.
        ushort[] Codes(byte[] lengths, int start, int size, bool whole)
        {
            var counts = new int[16];
            var next = new int[16];
            for (int i = 0; i < size; i++) counts[lengths[start + i]]++;
            int longest = 15, left = 1;
            while (longest > 0 && counts[longest] == 0) longest--;
            for (int length = 1; length < 16; length++)
                if ((left = 2 * left - counts[length]) < 0) throw Damaged();
            if (left > 0 && (whole || longest > 1)) throw Damaged();
            counts[0] = 0;
            for (int length = 1; length < 16; length++) next[length] = (next[length - 1] + counts[length - 1]) << 1;
            var codes = new ushort[1 << longest];
            for (int i = 0; i < size; i++)
            {
                int length = lengths[start + i], turned = 0;
                if (length == 0) continue;
                int code = next[length]++;
                for (int bit = 0; bit < length; bit++) turned |= (code >> bit & 1) << (length - 1 - bit);
                for (; turned < codes.Length; turned += 1 << length) codes[turned] = (ushort)(i << 4 | length);
            }
            return codes;
        }

        void Block(int kind)
        {
            if (kind == 3) throw Damaged();
            if (kind == 0)
            {
                Stored();
                return;
            }
            var lengths = new byte[320];
            int first = 288, second = 32;
            if (kind == 1)
                for (int i = 0; i < 320; i++)
                    lengths[i] = (byte)(i < 144 ? 8 : i < 256 ? 9 : i < 280 ? 7 : i < 288 ? 8 : 5);
            else
                ReadLengths(lengths, out first, out second);
            ushort[] literals = Codes(lengths, 0, first, false), distances = Codes(lengths, first, second, false);
            for (int next; (next = Symbol(literals)) != 256;)
            {
                if (next > 256)
                    Copy(next - 257, distances);
                else if (count == made.Length)
                    throw Damaged();
                else
                    made[count++] = (byte)next;
            }
        }

        void Stored()
        {
            Bits(heldCount % 8);
            int length = Bits(16), other = Bits(16);
            if (length != (other ^ 0xFFFF) || length > made.Length - count) throw Damaged();
            for (int i = 0; i < length; i++) made[count++] = (byte)Bits(8);
        }

        void ReadLengths(byte[] lengths, out int first, out int second)
        {
            first = Bits(5) + 257;
            second = Bits(5) + 1;
            int known = Bits(4) + 4;
            if (first > 286 || second > 30) throw Damaged();
            var own = new byte[19];
            for (int i = 0; i < known; i++) own[Order[i]] = (byte)Bits(3);
            ushort[] meta = Codes(own, 0, 19, true);
            for (int i = 0; i < first + second;)
            {
                int next = Symbol(meta);
                if (next < 16)
                {
                    lengths[i++] = (byte)next;
                    continue;
                }
                if (next == 16 && i == 0) throw Damaged();
                byte value = next == 16 ? lengths[i - 1] : (byte)0;
                int times = next == 16 ? 3 + Bits(2) : next == 17 ? 3 + Bits(3) : 11 + Bits(7);
                if (i + times > first + second) throw Damaged();
                for (int k = 0; k < times; k++) lengths[i++] = value;
            }
            if (lengths[256] == 0) throw Damaged();
        }

        void Copy(int which, ushort[] distances)
        {
            if (which > 28) throw Damaged();
            int length = Lengths[which] + (which < 8 || which == 28 ? 0 : Bits(which / 4 - 1));
            int far = Symbol(distances);
            if (far > 29) throw Damaged();
            int distance = Distances[far] + (far < 4 ? 0 : Bits(far / 2 - 1));
            if (distance > count || length > made.Length - count) throw Damaged();
            for (int i = 0; i < length; i++, count++) made[count] = made[count - distance];
        }
    }

    /// <summary>What persons are relative to.</summary>
    public sealed class Basis
    {
        const int Block = 1024; // sums that stay in the nearest cache while modes pass
        const double Lever = 16; // millimetres: a radian or a factor of an identity joint counts as that far

        public string Name;
        public ulong Digest;
        public readonly List<Mesh> Meshes = new List<Mesh>();
        public double[] Mean; // x y z of point after point
        public int[] Coarsest;
        public Level[] Levels; // the finer ones
        public float Step; // millimetres
        public int ModeCount;
        public short[] Modes = new short[0]; // steps: mode after mode all x, all y, all z
        public readonly List<Part> Parts = new List<Part>();
        public readonly List<Joint> Joints = new List<Joint>();
        public IdentityJoints IdentityJoints = new IdentityJoints();

        public int Points { get { return Mean.Length / 3; } }

        /// <summary>A basis, of the bytes of a .fpbasis.</summary>
        /// <exception cref="FacepipeException">they are none, are damaged, or don't fit each other</exception>
        public static Basis Read(byte[] file, string where)
        {
            if (file.Length < 20 || !Numbers.AreBytes(file, (byte)'F', (byte)'P', (byte)'B', (byte)'A'))
                throw new FacepipeException(where, "no basis, expected a file that begins with FPBA");
            if (file[4] != 1 || file[5] != 0 || file[6] != 0 || file[7] != 0)
                throw new FacepipeException(where, "expected version 1 without flags");
            uint size = Numbers.Little32(file, 16);
            if (size > Limits.Body) throw new FacepipeException(where, "expected at most 268435456 bytes of sections");
            byte[] body = new Inflater(file, 20, where).Inflated((int)size);
            Basis basis = new BasisReader(body, where).Read();
            basis.Digest = BitConverter.ToUInt64(file, 8);
            return basis;
        }

        /// <summary>Points by weights of the first modes, x y z of each.</summary>
        public double[] Shaped(double[] weights)
        {
            int count = Points;
            var points = (double[])Mean.Clone();
            var sums = new double[Block];
            for (int axis = 0; axis < 3; axis++)
            {
                for (int start = 0; start < count; start += Block)
                {
                    int size = Math.Min(Block, count - start);
                    Array.Clear(sums, 0, size);
                    int k = 0;
                    for (; k + 4 <= weights.Length; k += 4) AddFour(weights, k, axis, start, size, sums);
                    for (; k < weights.Length; k++)
                    {
                        double weight = Step * weights[k];
                        int at = (3 * k + axis) * count + start;
                        for (int i = 0; i < size; i++) sums[i] += weight * Modes[at + i];
                    }
                    for (int i = 0, at = 3 * start + axis; i < size; i++, at += 3) points[at] += sums[i];
                }
            }
            return points;
        }

        // Four modes at once, which takes half the time of one after another.
        void AddFour(double[] weights, int k, int axis, int start, int size, double[] sums)
        {
            int far = 3 * Points, a = k * far + axis * Points + start, b = a + far, c = b + far, d = c + far;
            double first = Step * weights[k], second = Step * weights[k + 1];
            double third = Step * weights[k + 2], fourth = Step * weights[k + 3];
            short[] modes = Modes;
            for (int i = 0; i < size; i++)
                sums[i] += first * modes[a + i] + second * modes[b + i] + third * modes[c + i] + fourth * modes[d + i];
        }

        /// <summary>Where joints are, x y z of each, by points.</summary>
        public double[] JointPlaces(double[] points)
        {
            var places = new double[3 * Joints.Count];
            for (int j = 0; j < Joints.Count; j++)
                for (int i = 0; i < Joints[j].Points.Length; i++)
                    for (int axis = 0; axis < 3; axis++)
                        places[3 * j + axis] += (double)Joints[j].Shares[i] * points[3 * Joints[j].Points[i] + axis];
            return places;
        }

        /// <summary>Points and joints of a person.</summary>
        /// <exception cref="FacepipeException">it is on another basis, or does not fit it</exception>
        public Rebuilt Rebuild(Person person, string where)
        {
            if (person.Basis != Digest)
                throw new FacepipeException(where, "a person on another basis, expected one on " + Name);
            if (person.Modes.Length > ModeCount) throw new FacepipeException(where, "more modes than its basis has");
            if (person.Parts.Length > 0 && person.Parts.Length != Parts.Count)
                throw new FacepipeException(where, "not the parts of its basis");
            if (person.Joints.Length > 9 * IdentityJoints.Count)
                throw new FacepipeException(where, "more joints than its basis has");
            double[] points = Shaped(person.Modes), mean = (double[])Mean.Clone();
            if (person.Joints.Length > 0) AddJoints(person, points);
            if (person.Whole != null)
            {
                var way = new Similarity(person.Whole, new double[3]);
                for (int i = 0; i < points.Length; i += 3)
                {
                    way.Apply(points, points, i);
                    way.Apply(mean, mean, i);
                }
            }
            for (int p = 0; p < person.Parts.Length; p++)
            {
                double[] from = Parts[p].WithModes ? points : mean;
                var way = new Similarity(person.Parts[p], Middle(Parts[p].Runs, from));
                for (int run = 0; run < Parts[p].Runs.Length; run += 2)
                    for (int i = Parts[p].Runs[run]; i < Parts[p].Runs[run + 1]; i++) way.Apply(from, points, 3 * i);
            }
            if (person.Points.Length > 0)
            {
                double[] offsets = new Offsets(this, person.Points, where + " -> points").All();
                for (int i = 0; i < points.Length; i++) points[i] += offsets[i];
            }
            return new Rebuilt { Points = points, Joints = JointPlaces(points) };
        }

        // Add what a person's identity joints make of the mean face.
        void AddJoints(Person person, double[] points)
        {
            IdentityJoints own = IdentityJoints;
            var ways = new double[12 * own.Count]; // three rows of four of each; of zeros: at rest
            for (int j = 0; j < person.Joints.Length / 9; j++) SetWay(person, j, ways);
            byte[] joints = own.Joints, weights = own.Weights;
            for (int at = 0, place = 3 * own.First; at < joints.Length; place += 3)
            {
                double x = Mean[place], y = Mean[place + 1], z = Mean[place + 2], dx = 0, dy = 0, dz = 0;
                for (int end = at + own.Width; at < end; at++)
                {
                    int way = 12 * joints[at];
                    double weight = weights[at];
                    dx += weight * (ways[way] * x + ways[way + 1] * y + ways[way + 2] * z + ways[way + 3]);
                    dy += weight * (ways[way + 4] * x + ways[way + 5] * y + ways[way + 6] * z + ways[way + 7]);
                    dz += weight * (ways[way + 8] * x + ways[way + 9] * y + ways[way + 10] * z + ways[way + 11]);
                }
                points[place] += dx;
                points[place + 1] += dy;
                points[place + 2] += dz;
            }
        }

        // M - 1 about a joint, a weight's 255th of it; M = T Rz Rx Ry S of its nine numbers.
        void SetWay(Person person, int joint, double[] ways)
        {
            var numbers = new double[9];
            for (int k = 0; k < 9; k++)
                numbers[k] = (k > 5 ? 1 : 0) + person.JointStep * person.Joints[9 * joint + k] / (k < 3 ? 1 : Lever);
            double sx = Math.Sin(numbers[3]), sy = Math.Sin(numbers[4]), sz = Math.Sin(numbers[5]);
            double cx = Math.Cos(numbers[3]), cy = Math.Cos(numbers[4]), cz = Math.Cos(numbers[5]);
            var turn = new[]
            {
                cz * cy - sz * sx * sy, -sz * cx, cz * sy + sz * sx * cy,
                sz * cy + cz * sx * sy, cz * cx, sz * sy - cz * sx * cy,
                -cx * sy, sx, cx * cy,
            };
            for (int row = 0; row < 3; row++)
            {
                int at = 12 * joint + 4 * row;
                double left = numbers[row];
                for (int k = 0; k < 3; k++)
                {
                    double value = turn[3 * row + k] * numbers[6 + k] - (k == row ? 1 : 0);
                    ways[at + k] = value / Limits.Full;
                    left -= value * IdentityJoints.Places[3 * joint + k];
                }
                ways[at + 3] = left / Limits.Full;
            }
        }

        static double[] Middle(int[] runs, double[] points)
        {
            var sum = new double[3];
            double count = 0;
            for (int run = 0; run < runs.Length; run += 2)
            {
                for (int i = 3 * runs[run]; i < 3 * runs[run + 1]; i += 3)
                    for (int axis = 0; axis < 3; axis++) sum[axis] += points[i + axis];
                count += runs[run + 1] - runs[run];
            }
            for (int axis = 0; axis < 3; axis++) sum[axis] /= count;
            return sum;
        }
    }

    // The body of a basis, section by section.
    sealed class BasisReader
    {
        readonly byte[] body;
        readonly string where;
        readonly Section[] known = new Section[9];
        readonly Basis made = new Basis();
        int points;

        public BasisReader(byte[] body, string where)
        {
            this.body = body;
            this.where = where;
            foreach (Section one in Section.All(body, 0, body.Length, where))
            {
                if (one.Kind < known.Length)
                    known[one.Kind] = one;
                else if (one.Required)
                    throw new FacepipeException(where, "section of kind " + one.Kind + ", expected a known one");
            }
        }

        public Basis Read()
        {
            Reader name = Open(1);
            made.Name = name.Text(name.Left);
            ReadMeshes();
            ReadMean();
            ReadLevels();
            if (known[5].Kind > 0) ReadModes();
            if (known[6].Kind > 0) ReadParts();
            if (known[7].Kind > 0) ReadJoints();
            if (known[8].Kind > 0) ReadIdentityJoints();
            return made;
        }

        Reader Open(int kind)
        {
            string trail = where + " -> section of kind " + kind;
            if (known[kind].Kind == 0) throw new FacepipeException(trail, "none, expected one");
            return new Reader(body, known[kind].Start, known[kind].Size, trail);
        }

        void ReadMeshes()
        {
            Reader reader = Open(2);
            long count = 0;
            while (reader.Left > 0)
            {
                string name = reader.Text(reader.Byte());
                uint own = reader.Four();
                if (count + own > Limits.Points) throw reader.Wrong((count + own) + " points, expected 1 to 1048576");
                made.Meshes.Add(new Mesh { Name = name, First = (int)count, Count = (int)own });
                count += own;
            }
            if (count == 0) throw reader.Wrong("no points, expected 1 to 1048576");
            points = (int)count;
        }

        void ReadMean()
        {
            Reader reader = Open(3);
            reader.Take(32); // of the topology, which a device has no faces to compare with
            uint grid = reader.Four();
            if (grid == 0 || grid > Limits.Grid) throw reader.Wrong(grid + " places in a mm, expected 1 to 1000000");
            long[] changes = reader.Planes(3L * points);
            reader.End();
            made.Mean = new double[changes.Length];
            for (int axis = 0; axis < 3; axis++)
            {
                long place = 0;
                for (int i = 0; i < points; i++)
                {
                    place += changes[axis * points + i];
                    made.Mean[3 * i + axis] = (double)place / grid;
                }
            }
        }

        void ReadLevels()
        {
            Reader reader = Open(4);
            int count = reader.Byte();
            var sizes = new uint[count + 1];
            long rows = 0, neighbours = 0;
            for (int i = 0; i <= count; i++) rows += sizes[i] = reader.Four();
            made.Levels = new Level[count];
            for (int i = 0; i < count; i++)
            {
                made.Levels[i] = new Level { Width = reader.Byte() };
                neighbours += (long)made.Levels[i].Width * sizes[i + 1];
            }
            if (rows > points) throw reader.Wrong(rows + " points of levels, expected at most those of meshes");
            long[] steps = reader.Planes(rows), away = reader.Planes(neighbours);
            var seen = new bool[points];
            made.Coarsest = Ascending(reader, steps, 0, (int)sizes[0], seen);
            int next = (int)sizes[0], near = 0;
            for (int i = 0; i < count; i++)
            {
                Level level = made.Levels[i];
                var coarser = (bool[])seen.Clone();
                level.Rows = Ascending(reader, steps, next, (int)sizes[i + 1], seen);
                ReadNeighbours(reader, away, near, level, coarser);
                next += level.Rows.Length;
                near += level.Neighbours.Length;
            }
            reader.End();
        }

        static int[] Ascending(Reader reader, long[] steps, int start, int count, bool[] seen)
        {
            if (count == 0) throw reader.Wrong("a level without points");
            var rows = new int[count];
            long row = 0;
            for (int i = 0; i < count; i++)
            {
                row += steps[start + i];
                if (row < 0 || row >= seen.Length || (i > 0 && steps[start + i] <= 0) || seen[row])
                    throw reader.Wrong("points of a level that don't ascend, or are in two, expected each once");
                rows[i] = (int)row;
                seen[row] = true;
            }
            return rows;
        }

        void ReadNeighbours(Reader reader, long[] away, int start, Level level, bool[] coarser)
        {
            int count = level.Rows.Length, width = level.Width, shares = reader.Take((long)count * width);
            level.Neighbours = new int[count * width];
            level.Shares = new sbyte[count * width];
            for (int i = 0; i < count; i++)
            {
                int sum = 0;
                for (int k = 0; k < width; k++)
                {
                    long near = level.Rows[i] + away[start + k * count + i];
                    if (near < 0 || near >= coarser.Length || !coarser[near])
                        throw reader.Wrong("neighbours that are in no coarser level, expected points that are");
                    level.Neighbours[i * width + k] = (int)near;
                    sum += level.Shares[i * width + k] = (sbyte)body[shares + k * count + i];
                }
                if (sum != Limits.Whole) throw reader.Wrong("shares of neighbours whose sum is not 64");
            }
        }

        // Each mode's residuals come level by level: what its neighbours' steps predict is added.
        void ReadModes()
        {
            Reader reader = Open(5);
            int count = reader.Two();
            float step = reader.Single();
            if (!(step > 0 && step <= 1e3f) || count == 0)
                throw reader.Wrong("expected modes in steps above 0, at most 1,000 mm");
            long numbers = 3L * count * points;
            int low = reader.Take(2 * numbers), high = low + (int)numbers;
            reader.End();
            var rest = new bool[points];
            for (int i = 0; i < points; i++) rest[i] = true;
            foreach (int row in made.Coarsest) rest[row] = false;
            foreach (Level level in made.Levels)
                foreach (int row in level.Rows) rest[row] = false;
            made.Step = step;
            made.ModeCount = count;
            made.Modes = new short[numbers];
            var steps = new short[points];
            for (int plane = 0; plane < 3 * count; plane++)
            {
                ReadPlane(low + plane * points, high + plane * points, rest, steps);
                Array.Copy(steps, 0, made.Modes, plane * points, points);
            }
        }

        void ReadPlane(int low, int high, bool[] rest, short[] steps)
        {
            foreach (int row in made.Coarsest) steps[row] = (short)Unfolded(low++, high++);
            foreach (Level level in made.Levels)
            {
                int[] near = level.Neighbours;
                sbyte[] shares = level.Shares;
                int at = 0;
                foreach (int row in level.Rows)
                {
                    int sum = Limits.Whole / 2;
                    for (int end = at + level.Width; at < end; at++) sum += shares[at] * steps[near[at]];
                    steps[row] = (short)(Unfolded(low++, high++) + (sum >> 6)); // modulo 2^16
                }
            }
            short before = 0;
            for (int row = 0; row < points; row++)
                if (rest[row]) steps[row] = before = (short)(before + Unfolded(low++, high++));
        }

        int Unfolded(int low, int high)
        {
            int folded = body[low] | body[high] << 8;
            return (folded >> 1) ^ -(folded & 1);
        }

        void ReadParts()
        {
            Reader reader = Open(6);
            while (reader.Left > 0)
            {
                if (made.Parts.Count == Limits.Parts) throw reader.Wrong("more than 16 parts");
                int kind = reader.Byte(), count = reader.Two();
                if (kind > 1 || count == 0) throw reader.Wrong("a part of no kind, or without points");
                if (8 * count > reader.Left) throw reader.Wrong("a part that ends early");
                var runs = new int[2 * count];
                for (int i = 0; i < runs.Length; i++)
                {
                    uint next = reader.Four();
                    if (next > points || (i > 0 && (i % 2 == 1 ? next <= runs[i - 1] : next < runs[i - 1])))
                        throw reader.Wrong("runs of a part that don't ascend, or leave the meshes");
                    runs[i] = (int)next;
                }
                made.Parts.Add(new Part { WithModes = kind == 1, Runs = runs });
            }
        }

        void ReadJoints()
        {
            Reader reader = Open(7);
            while (reader.Left > 0)
            {
                string path = reader.Text(reader.Byte());
                int count = reader.Byte();
                if (count == 0) throw reader.Wrong("a joint of no points");
                var joint = new Joint { Path = path, Points = new int[count], Shares = new float[count] };
                for (int i = 0; i < count; i++)
                {
                    uint point = reader.Four();
                    if (point >= points) throw reader.Wrong("a joint of points that are not there");
                    joint.Points[i] = (int)point;
                }
                for (int i = 0; i < count; i++)
                {
                    joint.Shares[i] = reader.Single();
                    if (float.IsNaN(joint.Shares[i]) || float.IsInfinity(joint.Shares[i]))
                        throw reader.Wrong("a joint whose shares are not finite");
                }
                made.Joints.Add(joint);
            }
        }

        void ReadIdentityJoints()
        {
            Reader reader = Open(8);
            int joints = reader.Byte(), width = reader.Byte();
            uint first = reader.Four(), count = reader.Four();
            if (joints == 0 || width == 0 || count == 0 || (long)first + count > points)
                throw reader.Wrong("joints of points that are not there");
            var own = new IdentityJoints { First = (int)first, Width = width, Places = new float[3 * joints] };
            for (int i = 0; i < own.Places.Length; i++)
            {
                own.Places[i] = reader.Single();
                if (!(Math.Abs(own.Places[i]) <= Limits.Farthest))
                    throw reader.Wrong("places above 100,000 mm, expected smaller ones");
            }
            int size = (int)count, indices = reader.Take((long)size * width), weights = reader.Take((long)size * width);
            reader.End();
            own.Joints = new byte[size * width];
            own.Weights = new byte[size * width];
            for (int i = 0, at = 0; i < size; i++)
            {
                int sum = 0;
                for (int k = 0; k < width; k++, at++)
                {
                    own.Joints[at] = body[indices + k * size + i];
                    if (own.Joints[at] >= joints) throw reader.Wrong("joints that are not there");
                    sum += own.Weights[at] = body[weights + k * size + i];
                }
                if (sum != Limits.Full) throw reader.Wrong("weights of a point whose sum is not 255");
            }
            made.IdentityJoints = own;
        }
    }

    /// <summary>Who somebody is.</summary>
    public sealed class Person
    {
        public ulong Basis;
        public double[] Modes = new double[0]; // weights of the first modes
        public Placement Whole; // or none
        public Placement[] Parts = new Placement[0]; // none, or one for each of the basis's
        public byte[] Points = new byte[0]; // offsets by levels
        public int[] Joints = new int[0]; // nine numbers of each of the first identity joints, in steps
        public double JointStep; // millimetres
        public readonly List<int> Skipped = new List<int>(); // kinds of sections that are there and were left out

        /// <summary>A person, of the bytes of a .fpb of version 2.</summary>
        /// <exception cref="FacepipeException">they are none, are damaged, have a section that is unknown and required,
        /// or numbers beyond limits</exception>
        public static Person Read(byte[] file, string where)
        {
            int end = file.Length - 4;
            if (end < 4 || !Numbers.AreBytes(file, (byte)'F', (byte)'P', (byte)'B', (byte)'C', 2, 0))
                throw new FacepipeException(where, "no person, expected FPBC and the version 2");
            if (end < 8 || Numbers.Crc32(file, end) != Numbers.Little32(file, end))
                throw new FacepipeException(where, "is damaged: its CRC differs");
            if (file[6] != 0 || file[7] != 0) throw new FacepipeException(where, "flags, expected none");
            var person = new Person();
            bool named = false;
            foreach (Section one in Section.All(file, 8, end, where))
            {
                if (one.Kind == 1)
                {
                    if (one.Size != 8) throw new FacepipeException(where + " -> basis", "expected 8 bytes");
                    person.Basis = BitConverter.ToUInt64(file, one.Start);
                    named = true;
                }
                else if (one.Kind <= 7)
                    person.Take(file, one, where);
                else if (one.Required)
                    throw new FacepipeException(where, "section of kind " + one.Kind + ", expected a known one");
                else
                    person.Skipped.Add(one.Kind);
            }
            if (!named) throw new FacepipeException(where, "no person: it names no basis");
            return person;
        }

        void Take(byte[] file, Section one, string where)
        {
            if (one.Kind == 2)
            {
                if (one.Size % 2 != 0 || one.Size == 0 || one.Size / 2 > Limits.Modes)
                    throw new FacepipeException(where + " -> modes", "expected 1 to 4,096 of 2 bytes");
                Modes = new double[one.Size / 2];
                for (int i = 0; i < Modes.Length; i++)
                {
                    Modes[i] = Numbers.Half(file, one.Start + 2 * i);
                    if (!(Math.Abs(Modes[i]) <= Limits.Weight))
                        throw new FacepipeException(where + " -> modes", "expected at most 100 standard deviations");
                }
            }
            else if (one.Kind == 3)
                Whole = Placements(file, one, 7, false, 1, where + " -> placement")[0];
            else if (one.Kind == 6)
            {
                Points = new byte[one.Size];
                Array.Copy(file, one.Start, Points, 0, one.Size);
            }
            else if (one.Kind == 7)
                TakeJoints(file, one, where + " -> joints");
            else
            {
                if (Parts.Length > 0)
                    throw new FacepipeException(where, "parts with turns and without, expected one of them");
                Parts = Placements(file, one, one.Kind == 5 ? 7 : 4, true, Limits.Parts, where + " -> parts");
            }
        }

        void TakeJoints(byte[] file, Section one, string where)
        {
            var reader = new Reader(file, one.Start, one.Size, where);
            JointStep = Numbers.Half(file, reader.Take(2));
            int count = reader.Byte();
            if (!(JointStep > 0 && JointStep <= Limits.Step) || count == 0)
                throw reader.Wrong("expected joints in steps of more than 0 and at most 10 mm");
            var bits = new BitReader(file, one.Start + 3, one.Start + one.Size, 3 * 7, where);
            Joints = new int[9 * count];
            for (int i = 0; i < Joints.Length; i++)
            {
                int context = i % 9 / 3 * 7;
                if (!bits.Bit(context)) continue;
                bool negative = bits.Number(1) == 1;
                int size = bits.Size(context + 1, 1);
                if (size > Limits.Steps) throw reader.Wrong("more than 127 steps, expected fewer");
                Joints[i] = negative ? -size : size;
            }
        }

        static Placement[] Placements(byte[] file, Section section, int each, bool half, int most, string where)
        {
            int width = half ? 2 : 4, count = section.Size / (width * each), at = section.Start;
            if (section.Size % (width * each) != 0 || count == 0 || count > most)
                throw new FacepipeException(where, "of a size that fits no placements");
            var found = new Placement[count];
            for (int row = 0; row < count; row++)
            {
                var values = new double[7];
                for (int i = 0; i < each; i++, at += width)
                {
                    double value = half ? Numbers.Half(file, at) : BitConverter.ToSingle(file, at);
                    values[each == 7 || i < 3 ? i : 6] = value;
                }
                var one = new Placement { Growth = values[6] };
                double squares = 0;
                bool sound = Math.Abs(one.Growth) <= Limits.Growth;
                for (int i = 0; i < 3; i++)
                {
                    one.Move[i] = values[i];
                    one.Turn[i] = values[3 + i];
                    squares += one.Turn[i] * one.Turn[i];
                    sound = sound && Math.Abs(one.Move[i]) <= Limits.Move && Math.Abs(one.Turn[i]) <= 1;
                }
                if (!sound || !(squares <= Limits.Turn))
                    throw new FacepipeException(where, "expected a move, part of a quaternion, a scale");
                found[row] = one;
            }
            return found;
        }
    }

    // LZMA's range coder, with probabilities that learn fast at first.
    sealed class BitReader
    {
        readonly byte[] data;
        readonly string where;
        readonly int[] likely, shifts;
        readonly int end;
        int place;
        uint code, span = uint.MaxValue;

        public BitReader(byte[] data, int place, int end, int contexts, string where)
        {
            this.data = data;
            this.place = place;
            this.end = end;
            this.where = where;
            likely = new int[contexts];
            shifts = new int[contexts];
            for (int i = 0; i < contexts; i++)
            {
                likely[i] = 1 << 15;
                shifts[i] = 1;
            }
            for (int i = 0; i < 4; i++) code = code << 8 | Next();
        }

        public bool Bit(int context)
        {
            int own = likely[context];
            uint bound = (span >> 12) * (uint)Math.Max(own >> 4, 1);
            bool one = code >= bound;
            if (one)
            {
                code -= bound;
                span -= bound;
                likely[context] = own - (own >> shifts[context]);
            }
            else
            {
                span = bound;
                likely[context] = own + ((65535 - own) >> shifts[context]);
            }
            if (shifts[context] < 5) shifts[context]++;
            Fill();
            return one;
        }

        // A number of some bits of even odds.
        public int Number(int bits)
        {
            int value = 0;
            for (int i = 0; i < bits; i++)
            {
                span >>= 1;
                value <<= 1;
                if (code >= span)
                {
                    code -= span;
                    value |= 1;
                }
                Fill();
            }
            return value;
        }

        // An Exp-Golomb number.
        public int Growing()
        {
            int length = 0;
            while (Number(1) == 1)
                if (++length > 15)
                    throw new FacepipeException(where, "a number of more than 15 bits, expected small ones");
            return (1 << length) - 1 + Number(length);
        }

        // A number of 1 or more in six contexts, each a stride from the one before.
        public int Size(int context, int stride)
        {
            int size = 1;
            while (size < 14 && Bit(context + (Math.Min(size, 6) - 1) * stride)) size++;
            return size == 14 ? size + Growing() : size;
        }

        uint Next()
        {
            if (place >= end + 4) throw new FacepipeException(where, "ends in the middle, expected more bytes");
            int at = place++;
            return at < end ? data[at] : 0u; // four zeros at the end may be left out
        }

        void Fill()
        {
            for (; span < 1u << 24; span <<= 8) code = code << 8 | Next();
        }
    }

    // Offsets of points, level by level, each predicted from its neighbours in coarser ones.
    sealed class Offsets
    {
        const double FinerSteps = 1.15; // of each coarser level
        readonly Basis basis;
        readonly string where;
        readonly BitReader bits;
        readonly double step;
        readonly int sent;
        readonly int[] steps; // without signs
        readonly double[] got; // millimetres

        public Offsets(Basis basis, byte[] data, string where)
        {
            this.basis = basis;
            this.where = where;
            if (data.Length < 5) throw new FacepipeException(where, "expected at least 5 bytes");
            step = BitConverter.ToSingle(data, 0);
            sent = data[4];
            if (!(step > 0 && step <= Limits.Move))
                throw new FacepipeException(where, "expected steps of more than 0 and at most 10,000 mm");
            if (sent > basis.Levels.Length) throw new FacepipeException(where, "more levels than the basis has");
            bits = new BitReader(data, 5, data.Length, 1 + 4 + 24 + 24, where);
            steps = new int[3 * basis.Points];
            got = new double[3 * basis.Points];
        }

        public double[] All()
        {
            Read(new Level { Rows = basis.Coarsest }, 0);
            for (int i = 0; i < basis.Levels.Length; i++)
            {
                Predict(basis.Levels[i]);
                if (i < sent) Read(basis.Levels[i], i + 1);
            }
            foreach (double value in got)
                if (!(Math.Abs(value) <= Limits.Move))
                    throw new FacepipeException(where, "offsets above 10,000 mm, expected smaller ones");
            return got;
        }

        void Predict(Level level)
        {
            int at = 0;
            foreach (int row in level.Rows)
            {
                double x = 0, y = 0, z = 0;
                for (int end = at + level.Width; at < end; at++)
                {
                    int near = 3 * level.Neighbours[at], share = level.Shares[at];
                    x += share * got[near];
                    y += share * got[near + 1];
                    z += share * got[near + 2];
                }
                got[3 * row] = x / Limits.Whole;
                got[3 * row + 1] = y / Limits.Whole;
                got[3 * row + 2] = z / Limits.Whole;
            }
        }

        void Read(Level level, int number)
        {
            if (!bits.Bit(0)) return;
            double size = step * Math.Pow(FinerSteps, number - sent);
            for (int i = 0; i < level.Rows.Length; i++)
            {
                int around = number > 0 ? MovesNear(level, i) : 3, before = 0;
                if (!bits.Bit(1 + around)) continue;
                for (int axis = 0; axis < 3; axis++)
                {
                    if ((axis < 2 || before > 0) && !bits.Bit(5 + (2 * axis + before) * 4 + around)) continue;
                    before = 1;
                    bool negative = bits.Number(1) == 1;
                    int count = bits.Size(29 + around, 4), at = 3 * level.Rows[i] + axis;
                    steps[at] = count;
                    got[at] += (negative ? -count : count) * size;
                }
            }
        }

        // 0 to 3, by how many steps the four nearest neighbours have.
        int MovesNear(Level level, int row)
        {
            long total = 0;
            for (int k = 0; k < Math.Min(level.Width, 4); k++)
            {
                int near = 3 * level.Neighbours[row * level.Width + k];
                total += (long)steps[near] + steps[near + 1] + steps[near + 2];
            }
            return total > 3 ? 3 : total > 1 ? 2 : (int)total;
        }
    }

    // Points turned and scaled about a point, then moved.
    sealed class Similarity
    {
        readonly double[] matrix, about, move = new double[3];

        public Similarity(Placement placement, double[] about)
        {
            double x = placement.Turn[0], y = placement.Turn[1], z = placement.Turn[2];
            double w = Math.Sqrt(Math.Max(1 - (x * x + y * y + z * z), 0));
            double length = Math.Sqrt(x * x + y * y + z * z + w * w), scale = Math.Exp(placement.Growth);
            x /= length;
            y /= length;
            z /= length;
            w /= length;
            matrix = new[]
            {
                1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
                2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
                2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y),
            };
            for (int i = 0; i < 9; i++) matrix[i] *= scale;
            this.about = about;
            for (int i = 0; i < 3; i++) move[i] = about[i] + placement.Move[i];
        }

        public void Apply(double[] from, double[] to, int at)
        {
            double x = from[at] - about[0], y = from[at + 1] - about[1], z = from[at + 2] - about[2];
            for (int i = 0; i < 3; i++)
                to[at + i] = matrix[3 * i] * x + matrix[3 * i + 1] * y + matrix[3 * i + 2] * z + move[i];
        }
    }
}
