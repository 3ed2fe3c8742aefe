/* Checks the runtime on this machine: cc -std=c99 check.c -lm && ./a.out model.bin golden.txt */
#define DDPRT_IMPLEMENTATION
#include "ddprt_runtime.h"

static int numbers(FILE *file, float *into, size_t count) {
  for (size_t index = 0; index < count; ++index)
    if (fscanf(file, "%f", into + index) != 1) return 0;
  return 1;
}

/* Largest difference from the golden light in units of its largest value; negative where golden.txt is not of this model. */
static double compare(const ddprt_model *model, FILE *file, float *values, float *frame) {
  unsigned points, texels, row, column;
  double worst = 0, largest = 1e-30;
  float expected[3], light[3];
  if (fscanf(file, "%u %u", &points, &texels) != 2 || points != model->points) return -1;
  if (!numbers(file, values, ddprt_value_count(model)) || ddprt_frame(model, values, frame) != DDPRT_OK) return -1;
  for (; texels; --texels) {
    if (fscanf(file, "%u %u", &row, &column) != 2 || row >= model->height || column >= model->width) return -1;
    if (!numbers(file, expected, 3)) return -1;
    ddprt_texel(model, frame, row, column, light);
    for (int c = 0; c < 3; ++c) {
      worst = fmax(worst, fabs((double)light[c] - expected[c]));
      largest = fmax(largest, fabs(expected[c]));
    }
  }
  return worst / largest;
}

int main(int count, char **words) {
  ddprt_model model;
  ddprt_status status = ddprt_load(&model, count > 1 ? words[1] : "model.bin");
  if (status != DDPRT_OK) {
    fprintf(stderr, "check: %s\n", ddprt_says(status));
    return 2;
  }
  FILE *file = fopen(count > 2 ? words[2] : "golden.txt", "r");
  float *values = malloc(ddprt_value_count(&model) * sizeof *values);
  float *frame = malloc(ddprt_frame_count(&model) * sizeof *frame);
  double error = file && values && frame ? compare(&model, file, values, frame) : -1;
  if (file) fclose(file);
  free(values);
  free(frame);
  ddprt_free(&model);
  printf("check: error %g\n", error);
  return error >= 0 && error < 1e-4 ? 0 : 1;
}
