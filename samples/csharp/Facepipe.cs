// Persons (.fpb) on their basis (.fpbasis), rebuilt on a device: one file of C# 7.3 without unsafe code or packages,
// for Unity and others.
//
// Written from docs/files.md, "A person", "A basis" and "Lids". Lengths are millimetres, Y is up, axes right-handed:
// Unity's x is the negative of this one. Every file may be hostile: counts are checked before memory is taken, and
// whatever is wrong is one FacepipeException of one line.
//
//   var basis = Facepipe.Basis.Read(File.ReadAllBytes("head.fpbasis"), "head.fpbasis");
//   var person = Facepipe.Person.Read(File.ReadAllBytes("me.fpb"), "me.fpb");
//   Facepipe.Rebuilt face = basis.Rebuild(person, "me.fpb");
//   List<Facepipe.LidShape> shapes = basis.FittedLids(face, "me.fpb");
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

    /// <summary>An eye; the right one is the mirror image of itself. Lengths are millimetres.</summary>
    public sealed class LidEye
    {
        public int[] Lids, Shell; // points of lids, and of the eyeball's outside
        public int First, After; // points of the eyeball
        public int[] Joints; // numbers of those that carry the upper lid and the lower
        public double[] Shares; // of these for each point of lids
        public double[] Centre; // of the mean's eyeball
        public double[] Balls, Stretches; // of each slider: what the eyeball and the lids' joints do
        public double[] Ends, Ways; // of each slider, and of each shape, x y z of each point of lids
        public double[][] Outside; // of the shell in bands of y, by x: direction from the centre, length
    }

    /// <summary>What blinks, looks and squints are fitted by.</summary>
    public sealed class Lids
    {
        public byte[] Rings, Upper, Links; // of each point of lids; Links are the points beside each
        public int[][] Beside; // those that are of lids
        public int[] Corners; // rows of the inner one and the outer
        public int Sliders, Cells;
        public double[] Reach; // Cells x Cells
        public double Farthest; // of these
        public readonly LidEye[] Eyes = new LidEye[2];
    }

    /// <summary>A shape of a person at a weight, 1 the last, others inbetweens.</summary>
    public sealed class LidShape
    {
        public string Name; // as ARKit has it
        public double Weight;
        public int[] Points; // of the basis
        public double[] Offsets; // x y z of each, millimetres
    }

    /// <summary>What a person is, in millimetres.</summary>
    public sealed class Rebuilt
    {
        public double[] Points; // x y z of point after point, of all meshes
        public double[] Joints; // x y z of each joint at rest
        public double[] Turns; // nine numbers of each: rows of its rotation; an inverse bind is the inverse of both
        public double[] Shapes; // nine numbers: rows of what offsets of shapes are multiplied by, but those of lids
    }

    /// <summary>Where a whole or a part lies.</summary>
    public sealed class Placement
    {
        public readonly double[] Move = new double[3], Turn = new double[3];
        public double Growth; // logarithm of the scale

        internal bool IsSound
        {
            get
            {
                double squares = 0;
                bool sound = Math.Abs(Growth) <= Limits.Growth;
                for (int i = 0; i < 3; i++)
                {
                    squares += Turn[i] * Turn[i];
                    sound = sound && Math.Abs(Move[i]) <= Limits.Move && Math.Abs(Turn[i]) <= 1;
                }
                return sound && squares <= Limits.Turn;
            }
        }
    }

    static class Limits
    {
        public const int Body = 1 << 28, Points = 1 << 20, Grid = 1000000; // bytes, points, places in a millimetre
        public const int Sections = 64, Modes = 4096, Parts = 16, Whole = 64;
        public const int Rings = 13, Margin = 4, Ways = 7; // of lids, the margin's last, shapes and one at a half
        public const int Bands = 16; // of directions, by their y from -1 to 1
        public const int Steps = 127, Full = 255; // of a number of joints, and of a point's weights in sum
        public const double Step = 10, Farthest = 1e5; // millimetres, of identity joints
        public const double Angle = 0.1; // radians of a step, of how joints rest
        public const double Weight = 100, Move = 1e4, Growth = 3, Turn = 1.002; // half turns round in float16

        /// <summary>The band of a direction with that y.</summary>
        public static int BandOf(double y)
        {
            return y > -1 ? Math.Min((int)((y + 1) * (Bands / 2)), Bands - 1) : 0;
        }
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
        public Lids Lids; // none: lids are not fitted

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
            if (person.Rests.Length > 6 * Joints.Count)
                throw new FacepipeException(where, "more joints at rest than its basis has");
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
            var made = new Rebuilt { Points = points, Joints = JointPlaces(points), Shapes = new double[9] };
            made.Turns = new double[3 * made.Joints.Length];
            for (int j = 0; j < Joints.Count; j++)
            {
                var numbers = new double[6];
                if (6 * j < person.Rests.Length) Array.Copy(person.Rests, 6 * j, numbers, 0, 6);
                for (int axis = 0; axis < 3; axis++) made.Joints[3 * j + axis] += numbers[axis];
                Turned(numbers).CopyTo(made.Turns, 9 * j);
            }
            var shapes = new Similarity(person.Shapes, new double[3]);
            for (int k = 0; k < 3; k++)
            {
                var axis = new double[3];
                axis[k] = 1;
                shapes.Apply((double[])axis.Clone(), axis, 0);
                for (int i = 0; i < 3; i++) made.Shapes[3 * i + k] = axis[i];
            }
            return made;
        }

        /// <summary>Blinks, looks and squints that fit a person's eyeballs, in place of those of the head that everyone
        /// has; none where the basis has no tables of lids.</summary>
        /// <exception cref="FacepipeException">an eye without width</exception>
        public List<LidShape> FittedLids(Rebuilt person, string where)
        {
            var found = new List<LidShape>();
            if (Lids == null) return found;
            var eyes = new[] { new EyeFit(this, person, 0), new EyeFit(this, person, 1) };
            double scale = (eyes[0].Size + eyes[1].Size) / (eyes[0].MeanSize + eyes[1].MeanSize);
            const string blink = "eyeBlink", down = "eyeLookDown";
            string[] names =
                { blink, blink, blink, blink, "eyeLookUp", down, down, "eyeLookIn", "eyeLookOut", "eyeSquint" };
            double[] weights = { 0.25, 0.5, 0.75, 1, 1, 0.5, 1, 1, 1, 1 };
            for (int number = 0; number < 2; number++)
            {
                List<double[]> ways = eyes[number].Blinks(scale, where);
                ways.AddRange(eyes[number].Looks());
                for (int i = 0; i < ways.Count; i++)
                    found.Add(new LidShape
                    {
                        Name = names[i] + (number > 0 ? "Right" : "Left"),
                        Weight = weights[i],
                        Points = Lids.Eyes[number].Lids,
                        Offsets = eyes[number].Back(ways[i]),
                    });
            }
            return found;
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
            double[] turn = Turned(numbers);
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

        // Rz Rx Ry of a joint's numbers, row after row.
        static double[] Turned(double[] numbers)
        {
            double sx = Math.Sin(numbers[3]), sy = Math.Sin(numbers[4]), sz = Math.Sin(numbers[5]);
            double cx = Math.Cos(numbers[3]), cy = Math.Cos(numbers[4]), cz = Math.Cos(numbers[5]);
            return new[]
            {
                cz * cy - sz * sx * sy, -sz * cx, cz * sy + sz * sx * cy,
                sz * cy + cz * sx * sy, cz * cx, sz * sy - cz * sx * cy,
                -cx * sy, sx, cx * cy,
            };
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
        readonly Section[] known = new Section[10];
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
            if (known[9].Kind > 0) ReadLids();
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

        // Sums of `count` numbers one after another, in millimetres.
        static double[] Sums(Reader reader, int count, int times, double grid)
        {
            long[] changes = reader.Planes((long)count * times);
            var found = new double[changes.Length];
            long place = 0;
            for (int i = 0; i < found.Length; i++)
            {
                place = i % count > 0 ? place + changes[i] : changes[i];
                found[i] = place / grid;
                if (!(Math.Abs(found[i]) <= Limits.Farthest)) throw reader.Wrong("lids or eyeballs above 100,000 mm");
            }
            return found;
        }

        // The same of points: all x, then y, then z, as x y z of each.
        static double[] Ways(Reader reader, int count, int times)
        {
            double[] found = Sums(reader, count, 3 * times, 100);
            var turned = new double[found.Length];
            for (int i = 0; i < found.Length; i++)
                turned[i / (3 * count) * 3 * count + i % count * 3 + i / count % 3] = found[i];
            return turned;
        }

        byte[] Some(Reader reader, int count)
        {
            var found = new byte[count];
            Array.Copy(body, reader.Take(count), found, 0, count);
            return found;
        }

        void ReadLids()
        {
            Reader reader = Open(9);
            int count = reader.Two();
            var lids = new Lids { Sliders = reader.Byte(), Cells = reader.Two() };
            lids.Corners = new[] { reader.Two(), reader.Two() };
            lids.Rings = Some(reader, count);
            lids.Upper = Some(reader, count);
            lids.Links = Some(reader, count);
            byte[] inside = Some(reader, count);
            var sides = new bool[2 * Limits.Rings];
            for (int i = 0; i < count; i++)
            {
                if (lids.Rings[i] >= Limits.Rings || lids.Upper[i] > 1)
                    throw reader.Wrong("rings of lids that are not there");
                if (inside[i] > lids.Links[i] || lids.Links[i] == 0)
                    throw reader.Wrong("points of lids that nothing is beside");
                sides[2 * lids.Rings[i] + lids.Upper[i]] = true;
            }
            for (int side = 0; side < 2 * (Limits.Margin + 1); side++)
                if (!sides[side]) throw reader.Wrong("rings 0 to 4, expected points above and below in each");
            if (Math.Max(lids.Corners[0], lids.Corners[1]) >= count || lids.Corners[0] == lids.Corners[1])
                throw reader.Wrong("corners of an eye that are not there");
            lids.Beside = new int[count][];
            for (int i = 0; i < count; i++)
            {
                lids.Beside[i] = new int[inside[i]];
                for (int k = 0; k < inside[i]; k++)
                {
                    lids.Beside[i][k] = reader.Two();
                    if (lids.Beside[i][k] >= count) throw reader.Wrong("points beside others that are not there");
                }
            }
            if (lids.Sliders == 0 || lids.Cells < 2 || lids.Cells > 1024)
                throw reader.Wrong("expected sliders, and 2 to 1,024 cells");
            lids.Reach = Sums(reader, lids.Cells * lids.Cells, 1, 10000);
            lids.Farthest = double.NegativeInfinity;
            foreach (double one in lids.Reach) lids.Farthest = Math.Max(lids.Farthest, one);
            for (int number = 0; number < 2; number++)
                lids.Eyes[number] = ReadEye(reader, count, lids.Sliders, number > 0 ? -1 : 1);
            reader.End();
            made.Lids = lids;
        }

        LidEye ReadEye(Reader reader, int count, int sliders, double mirror)
        {
            uint first = reader.Four(), after = reader.Four();
            var eye = new LidEye { Joints = new[] { reader.Two(), reader.Two() } };
            int outside = reader.Two();
            eye.Lids = EyePoints(reader, count);
            eye.Shell = EyePoints(reader, outside);
            if (!(first < after && after <= points) || outside < 3
                || Math.Max(eye.Joints[0], eye.Joints[1]) >= made.Joints.Count)
                throw reader.Wrong("points or joints of an eye that are not there");
            eye.First = (int)first;
            eye.After = (int)after;
            eye.Shares = new double[2 * count];
            for (int i = 0; i < 2 * count; i++) eye.Shares[i] = reader.Two() / 65535.0;
            eye.Centre = EyeNumbers(reader, 3);
            eye.Balls = EyeNumbers(reader, 4 * sliders);
            eye.Stretches = EyeNumbers(reader, 2 * sliders);
            eye.Ends = Ways(reader, count, sliders);
            eye.Ways = Ways(reader, count, Limits.Ways);
            var ways = new double[outside][];
            for (int i = 0; i < outside; i++)
            {
                var way = new double[4];
                for (int axis = 0; axis < 3; axis++)
                {
                    way[axis] = (axis > 0 ? 1 : mirror) * made.Mean[3 * eye.Shell[i] + axis] - eye.Centre[axis];
                    way[3] += way[axis] * way[axis];
                }
                way[3] = Math.Max(Math.Sqrt(way[3]), 1e-9);
                for (int axis = 0; axis < 3; axis++) way[axis] /= way[3];
                ways[i] = way;
            }
            Array.Sort(ways, (a, b) => a[0].CompareTo(b[0]));
            eye.Outside = new double[Limits.Bands][];
            for (int band = 0; band < Limits.Bands; band++)
            {
                var own = new List<double>();
                foreach (double[] way in ways)
                    if (Limits.BandOf(way[1]) == band) own.AddRange(way);
                eye.Outside[band] = own.ToArray();
            }
            return eye;
        }

        int[] EyePoints(Reader reader, int count)
        {
            if (4L * count > reader.Left) throw reader.Wrong("points of an eye that end early");
            var found = new int[count];
            for (int i = 0; i < count; i++)
            {
                uint row = reader.Four();
                if (row >= points) throw reader.Wrong("points of an eye that are not there");
                found[i] = (int)row;
            }
            return found;
        }

        static double[] EyeNumbers(Reader reader, int count)
        {
            var found = new double[count];
            for (int i = 0; i < count; i++)
            {
                found[i] = reader.Single();
                if (!(Math.Abs(found[i]) <= Limits.Farthest)) throw reader.Wrong("an eye above 100,000 mm");
            }
            return found;
        }
    }

    // Lids of an eye that slide over the eyeball: docs/files.md, "Lids". Arrays are x y z of point after point,
    // millimetres. The right eye is fitted as its mirror image.
    sealed class EyeFit
    {
        const double Far = -90; // below all that lies over an eyeball
        const double Nothing = -1.5; // less is no push: e^-15

        // by ring: millimetres over the eyeball in a blink, in a look, at the ends of sliders; of the margin's motion
        static readonly double[] Least = { -1, 0, 0.25, 0.8, 1.4, 1.7, 1.7, 1.7, 1.7, 1.5, 1, -1, -1 };
        static readonly double[] Over = { Far, 0, 0.2, 0.6, 1, 1.2, 1.2, 1.2, 1.2, 1.2, 1, Far, Far };
        static readonly double[] OverAtEnds = { Far, -1, -0.5, 0.1, 0.2, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3 };
        static readonly double[] Follow = { 0.6, 0.95, 1, 1, 1, 0.95, 0.81, 0.6, 0.42, 0.27, 0.17, 0.09, 0.03 };
        static readonly double[] Angles = { -0.5, 0, 0.5, 0, 0, -0.5, 0, 0.5 }; // up, down, in, out: about x, about y
        static readonly int[] OwnWays = { 1, 3, 4, 5 };

        readonly Lids tables;
        readonly LidEye eye;
        readonly int count;
        readonly double mirror;
        readonly double[] lids, average, heights = new double[2], way = new double[3];
        readonly double[] middle, squares, meanMiddle, meanSquares;
        double[] centre;
        double scale = 1;

        public EyeFit(Basis basis, Rebuilt person, int number)
        {
            tables = basis.Lids;
            eye = tables.Eyes[number];
            count = eye.Lids.Length;
            mirror = number > 0 ? -1 : 1;
            lids = Places(person.Points);
            average = Places(basis.Mean);
            Spread(person.Points, out middle, out squares);
            Spread(basis.Mean, out meanMiddle, out meanSquares);
            for (int i = 0; i < 2; i++) heights[i] = person.Joints[3 * eye.Joints[i] + 1];
        }

        // How far points of the eyeball are from its middle, of the person and of the mean.
        public double Size { get { return Math.Sqrt((squares[0] + squares[1] + squares[2]) / 3); } }

        public double MeanSize { get { return Math.Sqrt((meanSquares[0] + meanSquares[1] + meanSquares[2]) / 3); } }

        // At a quarter, a half, three quarters and 1, with eyeballs of a scale.
        public List<double[]> Blinks(double size, string where)
        {
            FitBall(size);
            double[] start = Lifted(lids), end = Lifted(Met(Lifted(Sum(start, Way(0))), where));
            var found = new List<double[]>();
            foreach (double share in new[] { 0.25, 0.5, 0.75, 1 })
            {
                double[] there = share < 1 ? Lifted(Arced(start, end, share)) : end;
                found.Add(Sum(there, start, -1));
            }
            return found;
        }

        // Up, down at a half, down, in, out, and the squint.
        public List<double[]> Looks()
        {
            double own = 0, mean = 0;
            for (int axis = 0; axis < 3; axis++)
            {
                own += Math.Sqrt(squares[axis]);
                mean += Math.Sqrt(meanSquares[axis]);
            }
            scale = own / mean;
            centre = new double[3];
            for (int axis = 0; axis < 3; axis++)
                centre[axis] = middle[axis] - scale * (meanMiddle[axis] - eye.Centre[axis]);
            double[] ahead = Turned(0, 0), squint = Way(6);
            double[] ofSquint = Larger(Need(squint, ahead, Over), NeedAtEnds(squint, ahead));
            var found = new List<double[]>();
            for (int look = 0; look < 4; look++)
            {
                bool hasMiddle = look == 1;
                double x = Angles[2 * look], y = Angles[2 * look + 1];
                double[] turned = Turned(x, y), full = Way(OwnWays[look]);
                double[] half = hasMiddle ? Way(2) : Sum(full, full, -0.5);
                double[] most = Larger(Need(full, ahead, Over), Need(full, turned, Over));
                most = Larger(most, NeedAtEnds(full, turned));
                double[] atHalf = Need(half, Turned(x / 2, y / 2), Over);
                if (!hasMiddle) most = Larger(most, Sum(atHalf, atHalf));
                double[] push = Pushes(most);
                if (hasMiddle) found.Add(Out(half, Pushes(Larger(atHalf, Sum(push, push, -0.5)))));
                found.Add(Out(full, push));
                ofSquint = Larger(ofSquint, Need(Sum(squint, found[found.Count - 1]), turned, OverAtEnds));
            }
            found.Add(Out(squint, Pushes(ofSquint)));
            return found;
        }

        // Offsets as they are on the side that the eye is.
        public double[] Back(double[] ways)
        {
            for (int i = 0; i < ways.Length; i += 3) ways[i] *= mirror;
            return ways;
        }

        static double[] Sum(double[] one, double[] other, double times = 1)
        {
            var found = new double[one.Length];
            for (int i = 0; i < found.Length; i++) found[i] = one[i] + times * other[i];
            return found;
        }

        static double[] Larger(double[] one, double[] other)
        {
            var found = new double[one.Length];
            for (int i = 0; i < found.Length; i++) found[i] = Math.Max(one[i], other[i]);
            return found;
        }

        // log(1 + e^x)
        static double Soft(double x)
        {
            double small = Math.Exp(-Math.Abs(x));
            return Math.Max(x, 0) + (small < 1e-5 ? small - small * small / 2 : Math.Log(1 + small));
        }

        double[] Places(double[] points)
        {
            var found = new double[3 * count];
            for (int i = 0; i < found.Length; i++)
                found[i] = (i % 3 == 0 ? mirror : 1) * points[3 * eye.Lids[i / 3] + i % 3];
            return found;
        }

        // The mean of the eyeball's points and their squares about it, by axes.
        void Spread(double[] points, out double[] mean, out double[] about)
        {
            mean = new double[3];
            about = new double[3];
            for (int axis = 0; axis < 3; axis++)
            {
                double sign = axis == 0 ? mirror : 1, size = eye.After - eye.First;
                for (int row = eye.First; row < eye.After; row++) mean[axis] += sign * points[3 * row + axis] / size;
                for (int row = eye.First; row < eye.After; row++)
                {
                    double off = sign * points[3 * row + axis] - mean[axis];
                    about[axis] += off * off / size;
                }
            }
        }

        double[] Way(int number)
        {
            var found = new double[3 * count];
            Array.Copy(eye.Ways, 3 * count * number, found, 0, found.Length);
            return found;
        }

        // How far the mean's eyeball reaches along `way`: the mean of the nearest three points of its outside.
        double Reach()
        {
            double x = way[0], y = way[1], z = way[2];
            int own = Limits.BandOf(y);
            double a = double.PositiveInfinity, b = a, c = a, p = 0, q = 0, r = 0;
            // the direction's band, then one above, one below ... until none on either side can have nearer ones
            for (int number = 0, shut = 0; number < 2 * Limits.Bands && shut < 2; number++)
            {
                int band = number % 2 > 0 ? own + (number + 1) / 2 : own - number / 2;
                double apart = number > 0 ? 2.0 * (number % 2 > 0 ? band : band + 1) / Limits.Bands - 1 - y : 0;
                if (band < 0 || band >= Limits.Bands || !(apart * apart < c))
                {
                    shut++;
                    continue;
                }
                shut = 0;
                double[] outside = eye.Outside[band];
                int low = 0, high = outside.Length / 4;
                while (low < high)
                {
                    int half = (low + high) / 2;
                    if (outside[4 * half] < x) low = half + 1;
                    else high = half;
                }
                for (int step = 4; step >= -4; step -= 8) // up first, then down
                    for (int at = step > 0 ? 4 * low : 4 * low - 4; at >= 0 && at < outside.Length; at += step)
                    {
                        double dx = outside[at] - x;
                        if (!(dx * dx < c)) break;
                        double dy = outside[at + 1] - y, dz = outside[at + 2] - z, square = dx * dx + dy * dy + dz * dz;
                        if (!(square < c)) continue;
                        if (square < b)
                        {
                            c = b;
                            r = q;
                            bool first = square < a;
                            b = first ? a : square;
                            q = first ? p : outside[at + 3];
                            if (!first) continue;
                            a = square;
                            p = outside[at + 3];
                        }
                        else
                        {
                            c = square;
                            r = outside[at + 3];
                        }
                    }
            }
            double u = 1 / (Math.Sqrt(a) + 1e-3), v = 1 / (Math.Sqrt(b) + 1e-3), w = 1 / (Math.Sqrt(c) + 1e-3);
            return (u * p + v * q + w * r) / (u + v + w);
        }

        // How far a point lies over the eyeball; `way` is its direction then.
        double Above(double[] points, int row)
        {
            for (int axis = 0; axis < 3; axis++) way[axis] = points[3 * row + axis] - centre[axis];
            double far = Math.Sqrt(way[0] * way[0] + way[1] * way[1] + way[2] * way[2]);
            for (int axis = 0; axis < 3; axis++) way[axis] /= far;
            return far - scale * Reach();
        }

        double[] Lifted(double[] points)
        {
            var found = (double[])points.Clone();
            for (int row = 0; row < count; row++)
            {
                double least = Least[tables.Rings[row]];
                if (least < 0) continue;
                double lift = 0.15 * Soft((least - Above(points, row)) / 0.15);
                for (int axis = 0; axis < 3; axis++) found[3 * row + axis] += lift * way[axis];
            }
            return found;
        }

        // Move the eyeball a little, so that lids lie on it as the mean's do on theirs: six steps of Gauss and Newton.
        void FitBall(double size)
        {
            var touching = new List<int>();
            for (int row = 0; row < count; row++)
                if (tables.Rings[row] == 2 || tables.Rings[row] == 3) touching.Add(row);
            centre = (double[])eye.Centre.Clone();
            scale = 1;
            var goals = new double[touching.Count];
            for (int i = 0; i < goals.Length; i++) goals[i] = Above(average, touching[i]);
            double[] start = Sum(eye.Centre, Sum(middle, meanMiddle, -1));
            centre = (double[])start.Clone();
            scale = size;
            for (int step = 0; step < 6; step++)
            {
                var rows = new double[3, 4];
                for (int a = 0; a < 3; a++)
                {
                    rows[a, a] = 1;
                    rows[a, 3] = start[a] - centre[a];
                }
                for (int i = 0; i < goals.Length; i++)
                {
                    double miss = Above(lids, touching[i]) - goals[i], weight = miss < 0 ? 9 : 1;
                    for (int a = 0; a < 3; a++)
                    {
                        for (int b = 0; b < 3; b++) rows[a, b] += weight * way[a] * way[b];
                        rows[a, 3] += weight * way[a] * miss;
                    }
                }
                centre = Sum(centre, Solved(rows));
            }
        }

        // Of a symmetric positive definite matrix and a column beside it.
        static double[] Solved(double[,] rows)
        {
            for (int i = 0; i < 3; i++)
                for (int k = i + 1; k < 3; k++)
                    for (int column = 3; column >= i; column--)
                        rows[k, column] -= rows[k, i] / rows[i, i] * rows[i, column];
            var found = new double[3];
            for (int i = 2; i >= 0; i--)
            {
                double sum = rows[i, 3];
                for (int k = i + 1; k < 3; k++) sum -= rows[i, k] * found[k];
                found[i] = sum / rows[i, i];
            }
            return found;
        }

        // Lids with the upper margin brought onto the lower one, and the lid drawn after it.
        double[] Met(double[] points, string where)
        {
            int inner = 3 * tables.Corners[0], outer = 3 * tables.Corners[1];
            double[] across = new double[3], axis = new double[3], along = new double[count];
            double square = 0;
            for (int k = 0; k < 3; k++)
            {
                across[k] = points[outer + k] - points[inner + k];
                square += across[k] * across[k];
            }
            for (int k = 0; k < 3; k++) axis[k] = across[k] / square;
            double flat = Math.Sqrt(axis[0] * axis[0] + axis[1] * axis[1]), sign = axis[0] < 0 ? -1 : 1;
            double[] down = { sign * axis[1] / flat, -sign * axis[0] / flat, 0 };
            for (int row = 0; row < count; row++)
            {
                for (int k = 0; k < 3; k++) along[row] += (points[3 * row + k] - points[inner + k]) * axis[k];
                if (double.IsNaN(along[row]) || double.IsInfinity(along[row]))
                    throw new FacepipeException(where + " -> lids", "an eye without width, expected corners apart");
            }
            var found = (double[])points.Clone();
            for (int ring = 0; ring < Limits.Rings; ring++)
            {
                int[] upper = Rows(Math.Min(ring, Limits.Margin), 1, along);
                int[] lower = Rows(Math.Min(ring, Limits.Margin), 0, along);
                double[] above = At(along, upper), below = At(along, lower), goals = new double[3 * lower.Length];
                for (int i = 0; i < lower.Length; i++) Array.Copy(points, 3 * lower[i], goals, 3 * i, 3);
                var moves = new double[3 * upper.Length];
                for (int i = 0; i < upper.Length; i++)
                {
                    double end = Math.Min(above[i] - below[0], below[below.Length - 1] - above[i]), aside = 0;
                    double taper = Math.Min(Math.Max(end / 0.04, 0), 1);
                    double[] goal = Between(above[i], below, goals);
                    for (int k = 0; k < 3; k++)
                    {
                        moves[3 * i + k] = taper * (goal[k] - points[3 * upper[i] + k]);
                        aside += moves[3 * i + k] * axis[k];
                    }
                    for (int k = 0; k < 3; k++) moves[3 * i + k] += 0.4 * taper * down[k] - aside * across[k];
                }
                foreach (int row in ring <= Limits.Margin ? upper : Rows(ring, 1, along))
                {
                    double[] move = Between(along[row], above, moves);
                    for (int k = 0; k < 3; k++) found[3 * row + k] += Follow[ring] * move[k];
                }
            }
            return found;
        }

        // Rows of a ring above or below, in their order along the eye.
        int[] Rows(int ring, int upper, double[] along)
        {
            var found = new List<int>();
            for (int row = 0; row < count; row++)
                if (tables.Rings[row] == ring && tables.Upper[row] == upper) found.Add(row);
            found.Sort((a, b) => along[a] != along[b] ? along[a].CompareTo(along[b]) : a.CompareTo(b));
            return found.ToArray();
        }

        static double[] At(double[] values, int[] rows)
        {
            var found = new double[rows.Length];
            for (int i = 0; i < rows.Length; i++) found[i] = values[rows[i]];
            return found;
        }

        // Values between known ones at ascending places; beyond these the first or the last.
        static double[] Between(double at, double[] places, double[] values)
        {
            int next = 0;
            while (next < places.Length && places[next] <= at) next++;
            int before = Math.Max(next - 1, 0);
            bool beyond = next == 0 || next == places.Length;
            double share = beyond ? 0 : (at - places[before]) / (places[next] - places[before]);
            next = Math.Min(next, places.Length - 1);
            var found = new double[3];
            for (int k = 0; k < 3; k++)
                found[k] = values[3 * before + k] + share * (values[3 * next + k] - values[3 * before + k]);
            return found;
        }

        // Points a share of their way on arcs around the eyeball's middle.
        double[] Arced(double[] start, double[] end, double share)
        {
            var found = new double[start.Length];
            double[] a = new double[3], b = new double[3];
            for (int at = 0; at < found.Length; at += 3)
            {
                double first = 0, last = 0, together = 0;
                for (int k = 0; k < 3; k++)
                {
                    a[k] = start[at + k] - centre[k];
                    b[k] = end[at + k] - centre[k];
                    first += a[k] * a[k];
                    last += b[k] * b[k];
                    together += a[k] * b[k];
                }
                first = Math.Sqrt(first);
                last = Math.Sqrt(last);
                double x = a[1] * b[2] - a[2] * b[1], y = a[2] * b[0] - a[0] * b[2], z = a[0] * b[1] - a[1] * b[0];
                double angle = Math.Max(Math.Atan2(Math.Sqrt(x * x + y * y + z * z), together), 1e-6);
                double far = ((1 - share) * first + share * last) / Math.Sin(angle);
                double p = far * Math.Sin((1 - share) * angle) / first, q = far * Math.Sin(share * angle) / last;
                for (int k = 0; k < 3; k++) found[at + k] = centre[k] + p * a[k] + q * b[k];
            }
            return found;
        }

        // A rotation about x and one about y, row by row; one of the angles is 0.
        static double[] Turned(double x, double y)
        {
            double a = Math.Cos(x), b = Math.Sin(x), c = Math.Cos(y), d = Math.Sin(y);
            return new[] { c, 0, d, b * d, a, -b * c, -a * d, b, a * c };
        }

        // How far an offset from the middle of a turned eyeball lacks to lie over it.
        double Lack(double x, double y, double z, double[] turn, double size, double least)
        {
            int cells = tables.Cells;
            double far = Math.Sqrt(x * x + y * y + z * z), ahead = x * turn[2] + y * turn[5] + z * turn[8];
            double flat = 1 / (far + Math.Max(ahead, -0.5 * far)), most = cells - 1;
            double u = ((x * turn[0] + y * turn[3] + z * turn[6]) * flat + 1.5) * (most / 3);
            double v = ((x * turn[1] + y * turn[4] + z * turn[7]) * flat + 1.5) * (most / 3);
            u = u > 0 ? Math.Min(u, most - 0.001) : 0; // NaN too
            v = v > 0 ? Math.Min(v, most - 0.001) : 0;
            int column = (int)u, row = (int)v, at = row * cells + column;
            double s = u - column, t = v - row;
            double[] reach = tables.Reach;
            double low = (1 - s) * reach[at] + s * reach[at + 1];
            double high = (1 - s) * reach[at + cells] + s * reach[at + cells + 1];
            return least + size * ((1 - t) * low + t * high) - far;
        }

        double[] Need(double[] ways, double[] turn, double[] least)
        {
            var found = new double[count];
            for (int row = 0, at = 0; row < count; row++, at += 3)
            {
                double x = lids[at] + ways[at] - centre[0], y = lids[at + 1] + ways[at + 1] - centre[1];
                double z = lids[at + 2] + ways[at + 2] - centre[2];
                found[row] = Lack(x, y, z, turn, scale, least[tables.Rings[row]]);
            }
            return found;
        }

        // The most that lids lack at an end of a slider. What lies as far above as no eyeball reaches is not looked up.
        double[] NeedAtEnds(double[] ways, double[] turn)
        {
            var found = new double[count];
            for (int row = 0; row < count; row++) found[row] = Nothing;
            for (int end = 0; end < 2 * tables.Sliders; end++)
            {
                int slider = end / 2, ball = 4 * slider, own = 3 * slider * count;
                double sign = end % 2 > 0 ? 1 : -1, size = scale * (1 + sign * eye.Balls[ball + 3]);
                double up = eye.Stretches[2 * slider], stretch = eye.Stretches[2 * slider + 1];
                for (int row = 0, at = 0; row < count; row++, at += 3, own += 3)
                {
                    double height = lids[at + 1] + ways[at + 1] + sign * eye.Ends[own + 1];
                    double carried = eye.Shares[row] * (up + stretch * (height - heights[0]))
                        + eye.Shares[count + row] * (up + stretch * (height - heights[1]));
                    double x = lids[at] + ways[at] + sign * (eye.Ends[own] - eye.Balls[ball]) - centre[0];
                    double y = height + sign * (carried - eye.Balls[ball + 1]) - centre[1];
                    double ahead = eye.Ends[own + 2] - eye.Balls[ball + 2];
                    double z = lids[at + 2] + ways[at + 2] + sign * ahead - centre[2];
                    double least = OverAtEnds[tables.Rings[row]], far = least + size * tables.Farthest - found[row];
                    if (far > 0 && x * x + y * y + z * z < far * far)
                        found[row] = Math.Max(found[row], Lack(x, y, z, turn, size, least));
                }
            }
            return found;
        }

        // Pushes of at least the need, as smooth as a skin drawn over them.
        double[] Pushes(double[] need)
        {
            var least = new double[count];
            for (int row = 0; row < count; row++) least[row] = 0.1 * Soft(need[row] / 0.1);
            double[] push = (double[])least.Clone(), next = new double[count];
            for (int round = 0; round < 12; round++)
            {
                for (int row = 0; row < count; row++)
                {
                    double sum = 0;
                    foreach (int near in tables.Beside[row]) sum += push[near];
                    next[row] = Math.Max(least[row], sum / tables.Links[row]);
                }
                double[] before = push;
                push = next;
                next = before;
            }
            return push;
        }

        double[] Out(double[] ways, double[] push)
        {
            var found = (double[])ways.Clone();
            for (int row = 0, at = 0; row < count; row++, at += 3)
            {
                double x = lids[at] + ways[at] - centre[0], y = lids[at + 1] + ways[at + 1] - centre[1];
                double z = lids[at + 2] + ways[at + 2] - centre[2];
                double share = push[row] / Math.Sqrt(x * x + y * y + z * z);
                found[at] += share * x;
                found[at + 1] += share * y;
                found[at + 2] += share * z;
            }
            return found;
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
        public Placement Shapes = new Placement(); // offsets of shapes turn and grow by it
        public double[] Rests = new double[0]; // millimetres and radians, six of each of the first joints, to its rest
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
                else if (one.Kind <= 7 || one.Kind == 12)
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
            else if (one.Kind == 12)
                TakeRig(file, one, where + " -> rig");
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
            Joints = JointNumbers(file, one.Start + 3, one.Start + one.Size, count, 9, where);
        }

        // How joints rest and shapes go, against what points and basis give.
        void TakeRig(byte[] file, Section one, string where)
        {
            var reader = new Reader(file, one.Start, one.Size, where);
            int at = reader.Take(12);
            for (int i = 0; i < 3; i++) Shapes.Turn[i] = Numbers.Half(file, at + 2 * i);
            Shapes.Growth = Numbers.Half(file, at + 6);
            double move = Numbers.Half(file, at + 8), turn = Numbers.Half(file, at + 10);
            if (!Shapes.IsSound || !(move > 0 && move <= Limits.Step && turn > 0 && turn <= Limits.Angle))
                throw reader.Wrong("expected part of a quaternion, a scale, steps of at most 10 mm and 0.1 radians");
            int[] steps = JointNumbers(file, at + 13, one.Start + one.Size, reader.Byte(), 6, where);
            Rests = new double[steps.Length];
            for (int i = 0; i < steps.Length; i++)
            {
                if (i % 6 > 2 && i > 5) steps[i] += steps[i - 6]; // turns are less that of the joint before
                Rests[i] = (i % 6 < 3 ? move : turn) * steps[i];
            }
        }

        // Whole numbers of joints, three channels of each kind.
        static int[] JointNumbers(byte[] file, int start, int end, int joints, int channels, string where)
        {
            var bits = new BitReader(file, start, end, 3 * 7, where);
            var numbers = new int[channels * joints];
            for (int i = 0; i < numbers.Length; i++)
            {
                int context = i % channels / 3 * 7;
                if (!bits.Bit(context)) continue;
                bool negative = bits.Number(1) == 1;
                int size = bits.Size(context + 1, 1);
                if (size > Limits.Steps) throw new FacepipeException(where, "more than 127 steps, expected fewer");
                numbers[i] = negative ? -size : size;
            }
            return numbers;
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
                for (int i = 0; i < 3; i++)
                {
                    one.Move[i] = values[i];
                    one.Turn[i] = values[3 + i];
                }
                if (!one.IsSound)
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
