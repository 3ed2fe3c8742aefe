// Indirect light from ddprt's textures. Written by `ddprt export` for one model: see README.md beside it.
#ifndef DDPRT_HLSL
#define DDPRT_HLSL

Texture2DArray _DdprtLayers;
@GLOW@Texture2D _DdprtConstant;
SamplerState ddprt_linear_clamp_sampler;
float4 _DdprtRow[@ROWS@];

// Irradiance in W/m2, before albedo; uv: lightmap coordinates with their origin at the top left, as glTF has them.
@LIGHT@

// Radiance that leaves diffusely. direct: irradiance of lamps, W/m2; exitant: 1 where the lightmap holds all that leaves.
float3 DdprtLeaving(float3 albedo, float3 direct, float3 indirect, float exitant) {
  return albedo * ((1.0 - exitant) * direct + indirect) * 0.3183098862;
}

// For a Custom Function node of Shader Graph.
void DdprtLight_float(float2 uv, out float3 irradiance) {
  irradiance = DdprtLight(uv);
}

#endif
