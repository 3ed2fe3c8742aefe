// Where light passes through triangles: opacity looked up as `ddprt.scene.holes` does, bilinear and repeating.

/** A function (triangle, u, v) => whether there is a hole; null without holes. */
export function opening(holes) {
  if (!holes) return null;
  const ends = [];
  let total = 0;
  for (let i = 0; i < holes.cutoff.length; i++) ends.push((total += holes.size[2 * i] * holes.size[2 * i + 1]));
  const wrap = (i, n) => ((i % n) + n) % n;
  return (triangle, u, v) => {
    const row = holes.row[triangle];
    if (row < 0) return false;
    const image = holes.image[row];
    const height = holes.size[2 * image];
    const width = holes.size[2 * image + 1];
    const at = (k) => (1 - u - v) * holes.uv[6 * row + k] + u * holes.uv[6 * row + 2 + k] + v * holes.uv[6 * row + 4 + k];
    const x = at(0) * width - 0.5;
    const y = at(1) * height - 0.5;
    const x0 = wrap(Math.floor(x), width);
    const y0 = wrap(Math.floor(y), height);
    const x1 = (x0 + 1) % width;
    const y1 = (y0 + 1) % height;
    const across = x - Math.floor(x);
    const down = y - Math.floor(y);
    const start = ends[image] - height * width;
    const line = (r) =>
      holes.opacity[start + r * width + x0] * (1 - across) + holes.opacity[start + r * width + x1] * across;
    return line(y0) * (1 - down) + line(y1) * down < holes.cutoff[image];
  };
}
