// model.bin of ddprt: loading, and measured light to the rows of a frame. It needs neither three.js nor a browser.

const MAGIC = "ddprt001";
const CONSTANT = 1;
const EXITANT = 2;
const RADIOSITY = 4;

export class Model {
  /** buffer: an ArrayBuffer of the file. Throws an Error whose message says what is wrong. */
  constructor(buffer) {
    const view = new DataView(buffer);
    const word = (at) => view.getUint32(at, true);
    const begins = String.fromCharCode(...new Uint8Array(buffer, 0, Math.min(8, buffer.byteLength)));
    if (buffer.byteLength < 52 || begins !== MAGIC) throw Error("model.bin: not a model of this version of ddprt; export it again");
    const end = buffer.byteLength - 4;
    if (crc(new Uint8Array(buffer, 0, end)) !== word(end)) throw Error("model.bin: damaged; export it again");
    [this.width, this.height, this.layers, this.maps, this.groups, this.points, this.samples] = Array.from({ length: 7 }, (_, i) =>
      word(8 + 4 * i),
    );
    const flags = word(36);
    this.radiosity = (flags & RADIOSITY) !== 0;
    this.gamma = view.getFloat32(40, true);
    this.depth = view.getFloat32(44, true);
    this.inputs = this.groups === 3 ? this.points : 3 * this.points;
    let at = 48;
    const take = (type, count) => {
      const size = count * type.BYTES_PER_ELEMENT;
      if (at + size > end) throw Error("model.bin: too short; export it again");
      at += size;
      return new type(buffer, at - size, count);
    };
    const area = this.width * this.height;
    const rows = this.groups * (this.maps + 1);
    for (const name of ["position", "normal", "albedo"]) this[name] = take(Float32Array, 3 * this.samples);
    this.offset = take(Float32Array, this.groups * this.inputs);
    this.matrix = take(Float32Array, rows * this.inputs);
    this.intercept = take(Float32Array, rows);
    this.home = take(Uint32Array, this.samples);
    this.texels = take(Uint16Array, 4 * area * this.layers); // (layers, height, width, 4) half floats, row 0 first
    this.constant = flags & CONSTANT ? take(Float32Array, 3 * area) : null;
    this.exitant = flags & EXITANT ? take(Uint8Array, area) : null;
    if (at !== end) throw Error("model.bin: its size is not what it says; export it again");
  }

  get rowCount() {
    return 3 * this.layers + 2;
  }

  /** (points, 3) measured light from the irradiance of the samples, (samples, 3), W/m². */
  average(shaded) {
    const values = new Float64Array(3 * this.points);
    const count = new Uint32Array(this.points);
    for (const home of this.home) ++count[home];
    for (let k = 0; k < this.samples; ++k)
      for (let c = 0; c < 3; ++c)
        values[3 * this.home[k] + c] += (shaded[3 * k + c] * (this.radiosity ? this.albedo[3 * k + c] : 1)) / count[this.home[k]];
    return values;
  }

  /** What the shader reads of a frame: rows of four floats. */
  rows(values) {
    const { groups, inputs, maps, layers } = this;
    const mono = groups === 3;
    const s = [0, 0, 0];
    for (let i = 0; i < values.length; ++i) s[mono ? i % 3 : 0] += values[i] ** 2;
    for (let c = 0; c < 3; ++c) s[c] = Math.sqrt(s[c]);
    if (!mono) s[1] = s[2] = s[0];
    if (!s.every(Number.isFinite)) throw Error("ddprt: measured light is not finite");
    const z = new Float64Array(groups * inputs);
    for (let i = 0; i < values.length; ++i) {
      const at = mono ? (i % 3) * inputs + Math.floor(i / 3) : i;
      const share = s[i % 3] > 0 ? values[i] / s[i % 3] : 0;
      z[at] = Math.sign(share) * Math.abs(share) ** (1 / this.gamma) - this.offset[at];
    }
    const rows = new Float32Array(4 * this.rowCount);
    for (let c = 0; c < 3; ++c) {
      const group = mono ? c : 0;
      for (let k = 0; k <= maps; ++k) {
        const row = group * (maps + 1) + k;
        let u = this.intercept[row];
        for (let i = 0; i < inputs; ++i) u += this.matrix[row * inputs + i] * z[group * inputs + i];
        const [layer, lane] = mono ? [k >> 2, k & 3] : [k, c];
        rows[k < maps ? 4 * (3 * layer + c) + lane : 12 * layers + c] = u;
      }
      rows[12 * layers + 4 + c] = s[c];
    }
    return rows;
  }
}

function crc(bytes) {
  const table = Uint32Array.from({ length: 256 }, (_, entry) => {
    for (let bit = 0; bit < 8; ++bit) entry = entry & 1 ? (entry >>> 1) ^ 0xedb88320 : entry >>> 1;
    return entry;
  });
  let sum = -1;
  for (const byte of bytes) sum = table[(sum ^ byte) & 255] ^ (sum >>> 8);
  return ~sum >>> 0;
}
