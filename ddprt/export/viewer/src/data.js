// The model as the page carries it: numbers in JSON, arrays as little-endian bytes in base64.

const TYPES = { f2: Uint16Array, f4: Float32Array, f8: Float64Array, i4: Int32Array, u1: Uint8Array };

function isArray(value) {
  return value !== null && typeof value === "object" && typeof value.base64 === "string";
}

function decoded(entry) {
  const text = atob(entry.base64);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return Object.assign(new TYPES[entry.type](bytes.buffer), { shape: entry.shape });
}

/** Every packed array within a value as a typed array with a `shape`. */
export function unpack(value) {
  if (isArray(value)) return decoded(value);
  if (Array.isArray(value)) return value.map(unpack);
  if (value === null || typeof value !== "object") return value;
  return Object.fromEntries(Object.entries(value).map(([key, entry]) => [key, unpack(entry)]));
}
