/* ddprt_runtime.h: indirect light from measured light, in C99 and with nothing but libm.
 *
 *   #define DDPRT_IMPLEMENTATION        in one file of the program, before it includes this one
 *   #include "ddprt_runtime.h"
 *
 *   ddprt_model model;
 *   if (ddprt_load(&model, "model.bin") != DDPRT_OK) ...
 *   float *values = malloc(ddprt_value_count(&model) * sizeof *values);
 *   float *frame = malloc(ddprt_frame_count(&model) * sizeof *frame);
 *   each frame: shade the samples (model.position, model.normal) with your lamps and shadows, W/m2, then
 *     ddprt_average(&model, shaded, values);
 *     ddprt_frame(&model, values, frame);
 *     ddprt_texel(&model, frame, row, column, light);   one texel, or
 *     ddprt_lightmap(&model, frame, lightmap);          all of them, or
 *     ddprt_rows(&model, frame, rows);                  what ddprt's shaders read
 *   ddprt_free(&model);
 *
 * A loaded model is never written to, so threads may share it; frames are the caller's. The layout of model.bin, which is
 * little-endian on every machine, is told in docs/engines.md. Row 0 is at the top. Light is irradiance in W/m2, before albedo.
 */
#ifndef DDPRT_RUNTIME_H
#define DDPRT_RUNTIME_H

#include <stddef.h>
#include <stdint.h>

typedef enum {
  DDPRT_OK = 0,
  DDPRT_NO_FILE,       /* cannot be opened or read */
  DDPRT_NOT_A_MODEL,   /* begins with something else */
  DDPRT_OTHER_VERSION, /* of the layout: export again */
  DDPRT_TRUNCATED,     /* shorter than its own numbers say */
  DDPRT_DAMAGED,       /* checksum or numbers are wrong */
  DDPRT_NO_MEMORY,
  DDPRT_NOT_FINITE     /* measured light is NaN or infinite */
} ddprt_status;

typedef struct {
  uint32_t width, height, layers, maps, groups, points, samples;
  uint32_t inputs;         /* of a group: points for mono channel (3 groups), 3 points for multi channel (1 group) */
  uint32_t radiosity;      /* whether shaded light is multiplied by albedo; ddprt_average does so */
  float gamma;             /* 1 in linear space */
  float depth;             /* metres behind the surface that lamps are shaded from, see docs/export.md */
  const float *position, *normal, *albedo; /* (samples, 3) */
  const uint32_t *home;                    /* (samples): the point that each is averaged into */
  const uint32_t *shared;                  /* (points): how many samples each has */
  const float *offset;                     /* (groups, inputs) */
  const float *matrix;                     /* (groups, maps + 1, inputs); the last row counts a texture of ones */
  const float *intercept;                  /* (groups, maps + 1) */
  const uint16_t *texels;                  /* (layers, height, width, 4) half floats */
  const float *constant;                   /* (height, width, 3) light that no lamp changes, or NULL */
  const uint8_t *exitant;                  /* (height, width) 1 where texels hold all that leaves, or NULL */
  void *memory;
} ddprt_model;

ddprt_status ddprt_load(ddprt_model *model, const char *path);
ddprt_status ddprt_parse(ddprt_model *model, const void *bytes, size_t size); /* keeps nothing of the bytes */
void ddprt_free(ddprt_model *model);
const char *ddprt_says(ddprt_status status);

size_t ddprt_value_count(const ddprt_model *model); /* floats of measured light: (points, 3) */
size_t ddprt_frame_count(const ddprt_model *model); /* floats of a frame: s (3), u (3, maps + 1), and space to work in */
size_t ddprt_row_count(const ddprt_model *model);   /* rows of four floats: (3 layers + 2) */

void ddprt_average(const ddprt_model *model, const float *shaded, float *values);
ddprt_status ddprt_frame(const ddprt_model *model, const float *values, float *frame);
void ddprt_texel(const ddprt_model *model, const float *frame, uint32_t row, uint32_t column, float light[3]);
void ddprt_lightmap(const ddprt_model *model, const float *frame, float *light); /* (height, width, 3) */
void ddprt_rows(const ddprt_model *model, const float *frame, float *rows);
float ddprt_half(uint16_t bits);

#endif

#if defined(DDPRT_IMPLEMENTATION) && !defined(DDPRT_IMPLEMENTED)
#define DDPRT_IMPLEMENTED

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { DDPRT_HEADER = 48, DDPRT_HAS_CONSTANT = 1, DDPRT_HAS_EXITANT = 2, DDPRT_RADIOSITY = 4, DDPRT_FLAGS = 7 };

static uint32_t ddprt_u32(const uint8_t *at) {
  return (uint32_t)at[0] | (uint32_t)at[1] << 8 | (uint32_t)at[2] << 16 | (uint32_t)at[3] << 24;
}

static float ddprt_f32(const uint8_t *at) {
  uint32_t bits = ddprt_u32(at);
  float value;
  memcpy(&value, &bits, sizeof value);
  return value;
}

/* CRC-32 as zip and PNG have it. */
static uint32_t ddprt_crc(const uint8_t *bytes, size_t size) {
  uint32_t table[256], crc = 0xffffffffu;
  for (uint32_t index = 0; index < 256; ++index) {
    uint32_t entry = index;
    for (int bit = 0; bit < 8; ++bit) entry = entry & 1 ? entry >> 1 ^ 0xedb88320u : entry >> 1;
    table[index] = entry;
  }
  for (size_t at = 0; at < size; ++at) crc = table[(crc ^ bytes[at]) & 255] ^ crc >> 8;
  return crc ^ 0xffffffffu;
}

float ddprt_half(uint16_t bits) {
  float size = (float)(bits & 1023);
  int exponent = bits >> 10 & 31;
  if (exponent == 31) size = bits & 1023 ? NAN : INFINITY;
  else size = exponent ? ldexpf(size + 1024, exponent - 25) : ldexpf(size, -24);
  return bits >> 15 ? -size : size;
}

/* Numbers of the header that fit each other, small enough that no product of them overflows 64 bits. */
static int ddprt_sound(const ddprt_model *m) {
  int whole = m->width && m->height && m->maps && m->points && m->samples;
  int small = m->width <= 65536 && m->height <= 65536 && m->maps <= 8192 && m->points <= 1u << 20 && m->samples <= 1u << 24;
  uint32_t layers = m->groups == 3 ? (m->maps + 3) / 4 : m->maps;
  return whole && small && (m->groups == 1 || m->groups == 3) && m->layers == layers && m->gamma > 0 && m->gamma <= 64 &&
         m->depth >= 0 && m->depth <= 1e30f;
}

static ddprt_status ddprt_fill(ddprt_model *m, const uint8_t *from, size_t floats, uint32_t flags) {
  size_t samples = m->samples, area = (size_t)m->width * m->height, halves = area * 4 * m->layers;
  size_t constant = flags & DDPRT_HAS_CONSTANT ? 3 * area : 0, exitant = flags & DDPRT_HAS_EXITANT ? area : 0;
  float *numbers = malloc((floats + constant) * sizeof(float) + (samples + m->points) * sizeof(uint32_t) +
                          halves * sizeof(uint16_t) + exitant);
  if (!numbers) return DDPRT_NO_MEMORY;
  m->memory = numbers;
  uint32_t *home = (uint32_t *)(numbers + floats + constant), *found = home + samples;
  uint16_t *texels = (uint16_t *)(found + m->points);
  uint8_t *leaving = (uint8_t *)(texels + halves);
  for (size_t index = 0; index < floats; ++index, from += 4) {
    numbers[index] = ddprt_f32(from);
    if (!isfinite(numbers[index])) return DDPRT_DAMAGED;
  }
  memset(found, 0, m->points * sizeof *found);
  for (size_t index = 0; index < samples; ++index, from += 4) {
    home[index] = ddprt_u32(from);
    if (home[index] >= m->points) return DDPRT_DAMAGED;
    ++found[home[index]];
  }
  for (size_t index = 0; index < m->points; ++index)
    if (!found[index]) return DDPRT_DAMAGED;
  for (size_t index = 0; index < halves; ++index, from += 2) texels[index] = (uint16_t)(from[0] | from[1] << 8);
  for (size_t index = 0; index < constant; ++index, from += 4) numbers[floats + index] = ddprt_f32(from);
  if (exitant) memcpy(leaving, from, exitant);
  size_t rows = (size_t)m->groups * (m->maps + 1), inputs = (size_t)m->groups * m->inputs;
  m->position = numbers;
  m->normal = m->position + 3 * samples;
  m->albedo = m->normal + 3 * samples;
  m->offset = m->albedo + 3 * samples;
  m->matrix = m->offset + inputs;
  m->intercept = m->matrix + rows * m->inputs;
  m->home = home;
  m->shared = found;
  m->texels = texels;
  m->constant = constant ? numbers + floats : NULL;
  m->exitant = exitant ? leaving : NULL;
  return DDPRT_OK;
}

ddprt_status ddprt_parse(ddprt_model *model, const void *bytes, size_t size) {
  const uint8_t *from = bytes;
  ddprt_model m = {0};
  memset(model, 0, sizeof *model);
  if (size < 8 || memcmp(from, "ddprt", 5) != 0) return DDPRT_NOT_A_MODEL;
  if (memcmp(from + 5, "001", 3) != 0) return DDPRT_OTHER_VERSION;
  if (size < DDPRT_HEADER + 4) return DDPRT_TRUNCATED;
  uint32_t *counts[] = {&m.width, &m.height, &m.layers, &m.maps, &m.groups, &m.points, &m.samples};
  for (size_t index = 0; index < 7; ++index) *counts[index] = ddprt_u32(from + 8 + 4 * index);
  uint32_t flags = ddprt_u32(from + 36);
  m.gamma = ddprt_f32(from + 40);
  m.depth = ddprt_f32(from + 44);
  if (!ddprt_sound(&m) || flags & ~(uint32_t)DDPRT_FLAGS) return DDPRT_DAMAGED;
  m.inputs = m.groups == 3 ? m.points : 3 * m.points;
  m.radiosity = flags & DDPRT_RADIOSITY ? 1 : 0;
  uint64_t area = (uint64_t)m.width * m.height, inputs = (uint64_t)m.groups * m.inputs;
  uint64_t floats = 9 * (uint64_t)m.samples + inputs + (m.maps + 1) * (inputs + m.groups);
  uint64_t whole = DDPRT_HEADER + 4 * floats + 4 * (uint64_t)m.samples + 8 * area * m.layers + 4;
  whole += (flags & DDPRT_HAS_CONSTANT ? 12 * area : 0) + (flags & DDPRT_HAS_EXITANT ? area : 0);
  if (size < whole) return DDPRT_TRUNCATED;
  if (size > whole || ddprt_crc(from, size - 4) != ddprt_u32(from + size - 4)) return DDPRT_DAMAGED;
  ddprt_status status = ddprt_fill(&m, from + DDPRT_HEADER, (size_t)floats, flags);
  if (status == DDPRT_OK) *model = m;
  else free(m.memory);
  return status;
}

ddprt_status ddprt_load(ddprt_model *model, const char *path) {
  uint8_t *bytes = NULL;
  size_t size = 0, room = 0, read;
  memset(model, 0, sizeof *model);
  FILE *file = fopen(path, "rb");
  if (!file) return DDPRT_NO_FILE;
  do {
    if (size == room) {
      uint8_t *wider = realloc(bytes, room = room ? 2 * room : 65536);
      if (!wider) {
        free(bytes);
        fclose(file);
        return DDPRT_NO_MEMORY;
      }
      bytes = wider;
    }
    size += read = fread(bytes + size, 1, room - size, file);
  } while (read);
  ddprt_status status = ferror(file) ? DDPRT_NO_FILE : ddprt_parse(model, bytes, size);
  fclose(file);
  free(bytes);
  return status;
}

void ddprt_free(ddprt_model *model) {
  free(model->memory);
  memset(model, 0, sizeof *model);
}

const char *ddprt_says(ddprt_status status) {
  static const char *const words[] = {
      "all is well",
      "the file cannot be read",
      "not a model of ddprt",
      "a model of another version of the layout: export it again",
      "the file is shorter than it says",
      "the file is damaged",
      "no memory",
      "measured light is not finite",
  };
  return (unsigned)status < sizeof words / sizeof *words ? words[status] : "unknown status";
}

size_t ddprt_value_count(const ddprt_model *m) { return 3 * (size_t)m->points; }

size_t ddprt_frame_count(const ddprt_model *m) { return 3 + 3 * ((size_t)m->maps + 1) + 3 * (size_t)m->points; }

size_t ddprt_row_count(const ddprt_model *m) { return 3 * (size_t)m->layers + 2; }

void ddprt_average(const ddprt_model *m, const float *shaded, float *values) {
  memset(values, 0, ddprt_value_count(m) * sizeof *values);
  for (size_t k = 0; k < m->samples; ++k)
    for (size_t c = 0; c < 3; ++c) {
      float light = shaded[3 * k + c] * (m->radiosity ? m->albedo[3 * k + c] : 1);
      values[3 * (size_t)m->home[k] + c] += light / (float)m->shared[m->home[k]];
    }
}

ddprt_status ddprt_frame(const ddprt_model *m, const float *values, float *frame) {
  size_t count = ddprt_value_count(m), rows = (size_t)m->maps + 1;
  float *s = frame, *u = frame + 3, *z = u + 3 * rows;
  double squares[3] = {0, 0, 0};
  for (size_t index = 0; index < count; ++index) {
    if (!isfinite(values[index])) return DDPRT_NOT_FINITE;
    squares[m->groups == 3 ? index % 3 : 0] += (double)values[index] * values[index];
  }
  for (size_t c = 0; c < 3; ++c) s[c] = (float)sqrt(squares[m->groups == 3 ? c : 0]);
  for (size_t index = 0; index < count; ++index) {
    size_t c = index % 3, group = m->groups == 3 ? c : 0, input = m->groups == 3 ? index / 3 : index;
    double share = squares[group] > 0 ? values[index] / sqrt(squares[group]) : 0;
    if (m->gamma != 1) share = copysign(pow(fabs(share), 1.0 / m->gamma), share);
    z[group * m->inputs + input] = (float)(share - m->offset[group * m->inputs + input]);
  }
  for (size_t c = 0; c < 3; ++c)
    for (size_t row = 0; row < rows; ++row) {
      size_t group = m->groups == 3 ? c : 0, at = group * rows + row;
      const float *weight = m->matrix + at * m->inputs, *told = z + group * m->inputs;
      double sum = m->intercept[at];
      for (size_t input = 0; input < m->inputs; ++input) sum += (double)weight[input] * told[input];
      u[c * rows + row] = (float)sum;
    }
  return DDPRT_OK;
}

void ddprt_texel(const ddprt_model *m, const float *frame, uint32_t row, uint32_t column, float light[3]) {
  size_t rows = (size_t)m->maps + 1, area = (size_t)m->width * m->height, at = (size_t)row * m->width + column;
  const float *s = frame, *u = frame + 3;
  for (size_t c = 0; c < 3; ++c) {
    double y = u[c * rows + m->maps];
    for (size_t k = 0; k < m->maps; ++k) {
      size_t layer = m->groups == 3 ? k / 4 : k, lane = m->groups == 3 ? k % 4 : c;
      y += (double)u[c * rows + k] * ddprt_half(m->texels[4 * (layer * area + at) + lane]);
    }
    y = y > 0 ? s[c] * (m->gamma == 1 ? y : pow(y, m->gamma)) : 0;
    light[c] = (float)(y + (m->constant ? m->constant[3 * at + c] : 0));
  }
}

void ddprt_lightmap(const ddprt_model *m, const float *frame, float *light) {
  for (uint32_t row = 0; row < m->height; ++row)
    for (uint32_t column = 0; column < m->width; ++column, light += 3) ddprt_texel(m, frame, row, column, light);
}

void ddprt_rows(const ddprt_model *m, const float *frame, float *rows) {
  size_t count = (size_t)m->maps + 1, last = 12 * (size_t)m->layers;
  const float *s = frame, *u = frame + 3;
  memset(rows, 0, 4 * ddprt_row_count(m) * sizeof *rows);
  for (size_t c = 0; c < 3; ++c) {
    for (size_t k = 0; k < m->maps; ++k) {
      size_t layer = m->groups == 3 ? k / 4 : k, lane = m->groups == 3 ? k % 4 : c;
      rows[4 * (3 * layer + c) + lane] = u[c * count + k];
    }
    rows[last + c] = u[c * count + m->maps];
    rows[last + 4 + c] = s[c];
  }
}

#endif
