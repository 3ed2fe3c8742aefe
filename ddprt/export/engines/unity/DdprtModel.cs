// model.bin of ddprt: loading, measured light to the rows of a frame. Plain C#, without a word of Unity.
using System;

public sealed class DdprtModel
{
    public int Width, Height, Layers, Maps, Groups, Points, Samples, Inputs;
    public bool Radiosity;
    public float Gamma, Depth;
    public float[] Position, Normal, Albedo, Offset, Matrix, Intercept, Constant;
    public int[] Home;
    public byte[] Texels, Exitant; // (layers, height, width, 4) half floats, row 0 first; (height, width), or null

    /// Rows of four floats that the shader reads.
    public int RowCount { get { return 3 * Layers + 2; } }

    /// Throws FormatException with a line that says what is wrong.
    public static DdprtModel Parse(byte[] bytes)
    {
        if (!BitConverter.IsLittleEndian) throw new FormatException("model.bin: needs a little-endian machine");
        if (bytes.Length < 52 || System.Text.Encoding.ASCII.GetString(bytes, 0, 8) != "ddprt001")
            throw new FormatException("model.bin: not a model of this version of ddprt; export it again");
        if (Crc(bytes, bytes.Length - 4) != BitConverter.ToUInt32(bytes, bytes.Length - 4))
            throw new FormatException("model.bin: damaged; export it again");
        var m = new DdprtModel();
        var head = new int[8];
        Buffer.BlockCopy(bytes, 8, head, 0, 32);
        m.Width = head[0]; m.Height = head[1]; m.Layers = head[2]; m.Maps = head[3];
        m.Groups = head[4]; m.Points = head[5]; m.Samples = head[6];
        m.Inputs = m.Groups == 3 ? m.Points : 3 * m.Points;
        m.Radiosity = (head[7] & 4) != 0;
        m.Gamma = BitConverter.ToSingle(bytes, 40);
        m.Depth = BitConverter.ToSingle(bytes, 44);
        int at = 48;
        m.Position = Floats(bytes, ref at, 3 * m.Samples);
        m.Normal = Floats(bytes, ref at, 3 * m.Samples);
        m.Albedo = Floats(bytes, ref at, 3 * m.Samples);
        m.Offset = Floats(bytes, ref at, m.Groups * m.Inputs);
        m.Matrix = Floats(bytes, ref at, m.Groups * (m.Maps + 1) * m.Inputs);
        m.Intercept = Floats(bytes, ref at, m.Groups * (m.Maps + 1));
        m.Home = new int[m.Samples];
        Buffer.BlockCopy(bytes, at, m.Home, 0, 4 * m.Samples);
        at += 4 * m.Samples;
        m.Texels = Bytes(bytes, ref at, 8 * m.Layers * m.Width * m.Height);
        if ((head[7] & 1) != 0) m.Constant = Floats(bytes, ref at, 3 * m.Width * m.Height);
        if ((head[7] & 2) != 0) m.Exitant = Bytes(bytes, ref at, m.Width * m.Height);
        if (at != bytes.Length - 4) throw new FormatException("model.bin: its size is not what it says; export it again");
        return m;
    }

    /// (points, 3) measured light from the irradiance of the samples, (samples, 3), W/m2.
    public float[] Average(float[] shaded)
    {
        var values = new float[3 * Points];
        var count = new int[Points];
        foreach (int home in Home) ++count[home];
        for (int k = 0; k < Samples; ++k)
            for (int c = 0; c < 3; ++c)
                values[3 * Home[k] + c] += shaded[3 * k + c] * (Radiosity ? Albedo[3 * k + c] : 1f) / count[Home[k]];
        return values;
    }

    /// The rows of a frame, four floats each.
    public float[] Rows(float[] values)
    {
        var s = new double[3];
        for (int i = 0; i < values.Length; ++i) s[Groups == 3 ? i % 3 : 0] += (double)values[i] * values[i];
        for (int c = 0; c < 3; ++c) s[c] = Math.Sqrt(s[c]);
        if (Groups == 1) s[1] = s[2] = s[0];
        if (double.IsNaN(s[0] + s[1] + s[2]) || double.IsInfinity(s[0] + s[1] + s[2]))
            throw new ArgumentException("ddprt: measured light is not finite");
        var z = new double[Groups * Inputs];
        for (int i = 0; i < values.Length; ++i)
        {
            int at = Groups == 3 ? i % 3 * Inputs + i / 3 : i;
            double share = s[i % 3] > 0 ? values[i] / s[i % 3] : 0;
            z[at] = Math.Sign(share) * Math.Pow(Math.Abs(share), 1.0 / Gamma) - Offset[at];
        }
        var rows = new float[4 * RowCount];
        for (int c = 0; c < 3; ++c)
        {
            int group = Groups == 3 ? c : 0;
            for (int k = 0; k <= Maps; ++k)
            {
                int row = group * (Maps + 1) + k;
                double u = Intercept[row];
                for (int i = 0; i < Inputs; ++i) u += Matrix[row * Inputs + i] * z[group * Inputs + i];
                int layer = Groups == 3 ? k / 4 : k, lane = Groups == 3 ? k % 4 : c;
                rows[k < Maps ? 4 * (3 * layer + c) + lane : 12 * Layers + c] = (float)u;
            }
            rows[12 * Layers + 4 + c] = (float)s[c];
        }
        return rows;
    }

    static float[] Floats(byte[] bytes, ref int at, int count)
    {
        if (count < 0 || at + 4L * count > bytes.Length) throw new FormatException("model.bin: too short; export it again");
        var found = new float[count];
        Buffer.BlockCopy(bytes, at, found, 0, 4 * count);
        at += 4 * count;
        return found;
    }

    static byte[] Bytes(byte[] bytes, ref int at, int count)
    {
        if (count < 0 || at + (long)count > bytes.Length) throw new FormatException("model.bin: too short; export it again");
        var found = new byte[count];
        Buffer.BlockCopy(bytes, at, found, 0, count);
        at += count;
        return found;
    }

    static uint Crc(byte[] bytes, int size)
    {
        uint crc = 0xffffffff;
        for (int at = 0; at < size; ++at)
        {
            crc ^= bytes[at];
            for (int bit = 0; bit < 8; ++bit) crc = (crc & 1) != 0 ? crc >> 1 ^ 0xedb88320 : crc >> 1;
        }
        return ~crc;
    }
}
