// From measured light to weights of the basis, and how far to trust them: the steps of docs/export.md.

export class Transfer {
  /** manifest, matrix (groups, bases, inputs), offset, intercept, and trust or null. */
  constructor(model) {
    Object.assign(this, model);
    const [groups, bases, inputs] = model.matrix.shape;
    Object.assign(this, { groups, bases, inputs });
    this.power = model.manifest.space === "gamma" ? model.manifest.gamma : 1;
  }

  /** Scale s (3) and encoded z (groups, inputs) of (points, 3) values. */
  encoded(values) {
    const mono = this.groups === 3;
    const scale = [0, 0, 0];
    for (let i = 0; i < values.length; i++) scale[mono ? i % 3 : 0] += values[i] ** 2;
    const s = mono ? scale.map(Math.sqrt) : Array(3).fill(Math.sqrt(scale[0]));
    const z = new Float64Array(this.groups * this.inputs);
    for (let i = 0; i < values.length; i++) {
      const group = mono ? i % 3 : 0;
      const share = s[group] > 0 ? values[i] / s[group] : 0;
      z[group * this.inputs + (mono ? Math.floor(i / 3) : i)] = Math.sign(share) * Math.abs(share) ** (1 / this.power);
    }
    return { s, z };
  }

  /** Weights (groups, bases) of the textures as they are stored. */
  weights(z) {
    const { groups, bases, inputs, matrix, offset, intercept } = this;
    const u = new Float64Array(groups * bases);
    for (let g = 0; g < groups; g++)
      for (let b = 0; b < bases; b++) {
        const row = (g * bases + b) * inputs;
        let sum = intercept[g * bases + b];
        for (let i = 0; i < inputs; i++) sum += matrix[row + i] * (z[g * inputs + i] - offset[g * inputs + i]);
        u[g * bases + b] = sum;
      }
    return u;
  }

  /** {score, novelty, extrapolating}; null for models of older versions. */
  trusted(s, z) {
    const ruler = this.trust;
    if (!ruler) return null;
    const { groups, inputs } = this;
    const count = ruler.directions.shape[1];
    let novelty = 0;
    let weight = 0;
    for (let g = 0; g < groups; g++) {
      const rest = z.slice(g * inputs, (g + 1) * inputs);
      const size = rest.reduce((sum, part) => sum + part * part, 0);
      const p = new Float64Array(count);
      for (let d = 0; d < count; d++)
        for (let i = 0; i < inputs; i++) p[d] += ruler.directions[(g * count + d) * inputs + i] * z[g * inputs + i];
      let share = 0;
      for (let d = 0; d < count; d++) {
        share += ruler.shares[g * count + d] * p[d] ** 2;
        for (let i = 0; i < inputs; i++) rest[i] -= ruler.directions[(g * count + d) * inputs + i] * p[d];
      }
      for (const part of rest) share += part * part;
      const own = groups === 3 ? s[g] ** 2 : 1;
      weight += own;
      novelty += own * (size > 0 ? share / size : 0);
    }
    novelty = weight > 0 ? Math.min(novelty / weight, 1) : 0;
    return { novelty, score: novelty > 0 ? 1 - novelty ** ruler.exponent : 1, extrapolating: novelty > ruler.level };
  }
}
