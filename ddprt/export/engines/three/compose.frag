#version 300 es
// The lightmap of a frame, or light at any place of it. Written by `ddprt export` for one model: see README.md beside it.
precision highp float;
precision highp sampler2DArray;
uniform sampler2DArray layers;
uniform highp sampler2D rows;
@GLOW@uniform highp sampler2D constant;
in vec2 lightmap;
out vec4 light;

// Irradiance in W/m², before albedo; uv: lightmap coordinates with their origin at the top left, as glTF has them.
@LIGHT@

void main() {
  light = vec4(ddprt_light(lightmap), 1.0);
}
