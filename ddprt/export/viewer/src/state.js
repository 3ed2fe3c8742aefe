// What a link restores: camera, lamps, toggles, as JSON after the hash. What does not fit is told, and nothing of it is taken.

const SHOWS = ["both", "direct", "indirect"];
const SOURCES = ["ours", "reference", "error", "basis"];

export function written(state) {
  const short = (key, value) => (typeof value === "number" ? Number(value.toPrecision(7)) : value);
  return "#" + encodeURIComponent(JSON.stringify(state, short));
}

const triple = (value) => Array.isArray(value) && value.length === 3 && value.every(Number.isFinite);
const direction = (value) => triple(value) && Math.hypot(...value) > 0;
const strength = (value) => triple(value) && value.every((x) => x >= 0);
const within = (low, high) => (value) => Number.isFinite(value) && value >= low && value <= high;

export function isLamp(lamp) {
  if (lamp === null || typeof lamp !== "object") return false;
  if (lamp.type === "directional") return direction(lamp.direction) && strength(lamp.irradiance);
  if (!triple(lamp.position) || !strength(lamp.intensity)) return false;
  if (lamp.type === "point") return true;
  const inner = lamp.inner_deg ?? 0;
  const outer = lamp.outer_deg ?? 45;
  return lamp.type === "spot" && direction(lamp.direction) && within(0, 89.999)(inner) && within(0, 90)(outer) && inner < outer;
}

/** The entries of a state that a hash holds; null for a hash without any, and an Error for one that cannot be read. */
export function parsed(hash, most) {
  if (hash.length < 2) return null;
  let state;
  try {
    state = JSON.parse(decodeURIComponent(hash.slice(1)));
  } catch {
    return new Error("it is cut off or was changed");
  }
  const checks = {
    eye: triple,
    target: triple,
    lamps: (value) => Array.isArray(value) && value.every(isLamp),
    chosen: (value) => Number.isInteger(value),
    show: (value) => SHOWS.includes(value),
    source: (value) => SOURCES.includes(value),
    basis: (value) => Number.isInteger(value) && value >= 0,
    bases: (value) => Number.isInteger(value) && value >= 1,
    exposure: within(-30, 30),
    albedo: (value) => typeof value === "boolean",
    lighting: (value) => value === null || Number.isInteger(value),
  };
  if (state === null || typeof state !== "object") return new Error("it holds no state");
  if (state.lamps?.length > most) return new Error(`${state.lamps.length} lamps, at most ${most}`);
  for (const [key, value] of Object.entries(state)) if (!checks[key]?.(value)) return new Error(`"${key}" is not as expected`);
  return state;
}
