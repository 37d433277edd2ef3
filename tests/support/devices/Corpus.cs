// What samples/csharp/Facepipe.cs makes of the cases of tests/support/person_corpus.py: as corpus.cpp.

using System;
using System.Collections.Generic;
using System.Diagnostics;
using System.Globalization;
using System.IO;
using Facepipe;

static class Corpus
{
    static IEnumerable<byte[]> Cases(string path)
    {
        using (var file = new BinaryReader(File.OpenRead(path)))
            while (file.BaseStream.Position < file.BaseStream.Length) yield return file.ReadBytes(file.ReadInt32());
    }

    static string Figures(double[] values)
    {
        double size = 0, weighted = 0, count = Math.Max(values.Length, 1);
        for (int i = 0; i < values.Length; i++)
        {
            size += Math.Abs(values[i]);
            weighted += values[i] * (1 + i % 7);
        }
        return string.Format(CultureInfo.InvariantCulture, " {0:G9} {1:G9}", size / count, weighted / count);
    }

    static string Line(Func<Rebuilt> of)
    {
        try
        {
            Rebuilt made = of();
            return "ok" + Figures(made.Points) + Figures(JointsOf(made));
        }
        catch (FacepipeException)
        {
            return "no";
        }
    }

    // Joints with how they are turned, and how shapes are.
    static double[] JointsOf(Rebuilt made)
    {
        var numbers = new List<double>(made.Joints);
        numbers.AddRange(made.Turns);
        numbers.AddRange(made.Shapes);
        return numbers.ToArray();
    }

    static Rebuilt Whole(Basis basis)
    {
        var weights = new double[basis.ModeCount];
        for (int i = 0; i < weights.Length; i++) weights[i] = 1;
        var steps = new int[9 * basis.IdentityJoints.Count];
        for (int i = 0; i < steps.Length; i++) steps[i] = 1;
        var person = new Person { Basis = basis.Digest, Modes = weights, Joints = steps, JointStep = 1 };
        Rebuilt made = TryLids(basis, basis.Rebuild(person, "case"));
        if (basis.Lids == null) return made;
        var numbers = new List<double>(made.Joints);
        numbers.AddRange(basis.Lids.Reach);
        foreach (LidEye eye in basis.Lids.Eyes)
            foreach (double[] own in new[] { eye.Centre, eye.Shares, eye.Balls, eye.Stretches, eye.Ends, eye.Ways })
                numbers.AddRange(own);
        made.Joints = numbers.ToArray();
        return made;
    }

    // Lids of whatever points: offsets, or one line.
    static Rebuilt TryLids(Basis basis, Rebuilt made)
    {
        try
        {
            basis.FittedLids(made, "case");
        }
        catch (FacepipeException)
        {
        }
        return made;
    }

    static double Milliseconds() { return Process.GetCurrentProcess().TotalProcessorTime.TotalMilliseconds; }

    static void Main(string[] words)
    {
        if (words[0] == "bases")
        {
            foreach (byte[] one in Cases(words[1])) Console.WriteLine(Line(() => Whole(Basis.Read(one, "case"))));
            return;
        }
        double before = Milliseconds();
        Basis basis = Basis.Read(File.ReadAllBytes(words[1]), words[1]);
        if (words[0] == "persons")
        {
            foreach (byte[] one in Cases(words[2]))
                Console.WriteLine(Line(() => TryLids(basis, basis.Rebuild(Person.Read(one, "case"), "case"))));
            return;
        }
        double loaded = Milliseconds();
        byte[] data = File.ReadAllBytes(words[2]);
        Rebuilt made = basis.Rebuild(Person.Read(data, words[2]), words[2]);
        if (words[0] == "time")
        {
            double start = Milliseconds();
            for (int i = 0; i < 20; i++) basis.Rebuild(Person.Read(data, words[2]), words[2]);
            double each = (Milliseconds() - start) / 20;
            basis.FittedLids(made, words[2]);
            start = Milliseconds();
            for (int i = 0; i < 20; i++) basis.FittedLids(made, words[2]);
            double lids = (Milliseconds() - start) / 20;
            Console.WriteLine(string.Format(CultureInfo.InvariantCulture, "{0:F1} {1:F2} {2:F2}", loaded - before, each, lids));
            return;
        }
        var arrays = new List<double[]> { made.Points, JointsOf(made) };
        if (words[0] == "lids")
        {
            arrays.Clear();
            foreach (LidShape shape in basis.FittedLids(made, words[2]))
            {
                Console.WriteLine(string.Format(CultureInfo.InvariantCulture, "{0} {1}", shape.Name, shape.Weight));
                arrays.Add(shape.Offsets);
            }
        }
        using (var file = new BinaryWriter(File.Create(words[3])))
            foreach (double[] values in arrays)
                foreach (double value in values) file.Write(value);
    }
}
