// Composes the lightmap of a DdprtModel on the graphics card. Written by the manual of Unity; not run in Unity by ddprt's tests.
using System;
using System.IO;
using UnityEngine;

public class DdprtLightmap : MonoBehaviour
{
    public ComputeShader compose;               // DdprtCompose.compute
    public string path = "ddprt/model.bin";     // under StreamingAssets
    public RenderTexture Lightmap { get; private set; }
    public DdprtModel Model { get; private set; }
    Texture2DArray layers;
    Texture2D constant;
    Vector4[] rows;

    void OnEnable()
    {
        Model = DdprtModel.Parse(File.ReadAllBytes(Path.Combine(Application.streamingAssetsPath, path)));
        layers = new Texture2DArray(Model.Width, Model.Height, Model.Layers, TextureFormat.RGBAHalf, false, true);
        int size = 8 * Model.Width * Model.Height;
        for (int layer = 0; layer < Model.Layers; ++layer) layers.SetPixelData(Model.Texels, 0, layer, layer * size);
        layers.Apply(false, true);
        if (Model.Constant != null)
        {
            var four = new float[4 * Model.Width * Model.Height];
            for (int i = 0; i < four.Length; ++i) four[i] = i % 4 < 3 ? Model.Constant[i / 4 * 3 + i % 4] : 0f;
            constant = new Texture2D(Model.Width, Model.Height, TextureFormat.RGBAFloat, false, true);
            constant.SetPixelData(four, 0);
            constant.Apply(false, true);
        }
        Lightmap = new RenderTexture(Model.Width, Model.Height, 0, RenderTextureFormat.ARGBFloat, RenderTextureReadWrite.Linear);
        Lightmap.enableRandomWrite = true;
        Lightmap.Create();
        rows = new Vector4[Model.RowCount];
    }

    /// shaded: irradiance at Model.Position with Model.Normal, (samples, 3), W/m2, by your own lamps and shadows.
    public void Relight(float[] shaded)
    {
        float[] told = Model.Rows(Model.Average(shaded));
        for (int i = 0; i < rows.Length; ++i) rows[i] = new Vector4(told[4 * i], told[4 * i + 1], told[4 * i + 2], told[4 * i + 3]);
        compose.SetVectorArray("_DdprtRow", rows);
        compose.SetVector("_DdprtSize", new Vector2(Model.Width, Model.Height));
        compose.SetTexture(0, "_DdprtLayers", layers);
        if (constant != null) compose.SetTexture(0, "_DdprtConstant", constant);
        compose.SetTexture(0, "_DdprtResult", Lightmap);
        compose.Dispatch(0, (Model.Width + 7) / 8, (Model.Height + 7) / 8, 1);
    }

    void OnDisable()
    {
        Destroy(layers);
        if (constant != null) Destroy(constant);
        if (Lightmap != null) Lightmap.Release();
    }
}
