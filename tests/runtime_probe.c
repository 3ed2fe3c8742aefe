/* Drives ddprt_runtime.h for tests: lightmaps of frames, averages of shaded samples, and files that are cut off or changed. */
#define DDPRT_IMPLEMENTATION
#include "ddprt_runtime.h"

static void *room(size_t count, size_t size) {
  void *found = malloc(count * size + 1);
  if (!found) exit(9);
  return found;
}

/* From shaded samples on standard input to what is made of them, as floats on standard output: values, rows, lightmap. */
static int relight(const ddprt_model *m) {
  size_t texels = 3 * (size_t)m->width * m->height, shaded_count = 3 * (size_t)m->samples;
  float *shaded = room(shaded_count, 4), *values = room(ddprt_value_count(m), 4), *frame = room(ddprt_frame_count(m), 4);
  float *rows = room(4 * ddprt_row_count(m), 4), *light = room(texels, 4);
  ddprt_status status = DDPRT_NO_FILE;
  if (fread(shaded, 4, shaded_count, stdin) == shaded_count) {
    ddprt_average(m, shaded, values);
    status = ddprt_frame(m, values, frame);
  }
  if (status == DDPRT_OK) {
    ddprt_rows(m, frame, rows);
    ddprt_lightmap(m, frame, light);
    fwrite(values, 4, ddprt_value_count(m), stdout);
    fwrite(rows, 4, 4 * ddprt_row_count(m), stdout);
    fwrite(light, 4, texels, stdout);
  }
  free(shaded), free(values), free(frame), free(rows), free(light);
  return (int)status;
}

static void seal(uint8_t *bytes, size_t size) {
  uint32_t crc = ddprt_crc(bytes, size - 4);
  for (int k = 0; k < 4; ++k) bytes[size - 4 + k] = (uint8_t)(crc >> 8 * k);
}

/* Every length, every byte of the header changed with a checksum that agrees, and random changes of either kind. */
static int abuse(const char *path) {
  FILE *file = fopen(path, "rb");
  if (!file) return 1;
  uint8_t *bytes = room(1 << 22, 1);
  size_t size = fread(bytes, 1, 1 << 22, file);
  fclose(file);
  ddprt_model model;
  unsigned long counts[DDPRT_NOT_FINITE + 1] = {0}, taken = 0;
  uint32_t seed = 1;
  for (size_t length = 0; length < size; length += length < 4096 ? 1 : 97) {
    uint8_t *part = room(length, 1); /* of its own, so that a read past the end is seen */
    memcpy(part, bytes, length);
    ddprt_status status = ddprt_parse(&model, part, length);
    if (status == DDPRT_OK || model.memory) return 2;
    ++counts[status];
    free(part);
  }
  for (int turn = 0; turn < 4000; ++turn) {
    seed = seed * 1664525u + 1013904223u;
    size_t at = turn < 40 * 8 ? 8 + (size_t)turn / 8 : (seed >> 8) % size;
    uint8_t kept[5] = {bytes[at], bytes[size - 4], bytes[size - 3], bytes[size - 2], bytes[size - 1]};
    bytes[at] ^= (uint8_t)(turn < 40 * 8 ? 1u << turn % 8 : 1 + (seed >> 3) % 255);
    int sealed = turn < 40 * 8 || turn % 2;
    if (sealed) seal(bytes, size);
    ddprt_status status = ddprt_parse(&model, bytes, size);
    if (status == DDPRT_OK && !sealed) return 3;
    if (status == DDPRT_OK) { /* whatever a sound checksum let in must be safe to use */
      float *values = room(ddprt_value_count(&model), 4), *frame = room(ddprt_frame_count(&model), 4), light[3];
      memset(values, 0, 4 * ddprt_value_count(&model));
      if (ddprt_frame(&model, values, frame) != DDPRT_OK) return 4;
      ddprt_texel(&model, frame, model.height - 1, model.width - 1, light);
      free(values), free(frame);
      ++taken;
    }
    ++counts[status];
    ddprt_free(&model);
    bytes[at] = kept[0];
    memcpy(bytes + size - 4, kept + 1, 4);
  }
  for (int status = 0; status <= DDPRT_NOT_FINITE; ++status) printf("%lu ", counts[status]);
  free(bytes);
  return taken ? 0 : 5;
}

int main(int count, char **words) {
  if (count < 2) return 1;
  if (count > 2) return abuse(words[1]);
  ddprt_model model;
  ddprt_status status = ddprt_load(&model, words[1]);
  if (status == DDPRT_OK) status = (ddprt_status)relight(&model);
  ddprt_free(&model);
  if (status != DDPRT_OK) fprintf(stderr, "%s", ddprt_says(status));
  return (int)status;
}
