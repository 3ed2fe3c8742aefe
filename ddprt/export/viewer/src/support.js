// What the page needs of its browser, and how it says that it cannot start.

/** What this browser lacks, in a line; null where it lacks nothing. */
export function missing() {
  const gl = document.createElement("canvas").getContext("webgl2");
  if (!gl) return "this page needs WebGL2, and this browser offers none; switch hardware acceleration on, or use another browser";
  const floats = gl.getExtension("EXT_color_buffer_float");
  gl.getExtension("WEBGL_lose_context")?.loseContext(); // browsers keep few contexts
  if (!floats) return "this browser cannot draw into float textures (EXT_color_buffer_float); use another one";
  return null;
}

/** A line across the picture, instead of a panel that nothing answers. */
export function refuse(why) {
  document.body.classList.add("bare");
  document.getElementById("hide").hidden = true;
  warn(why);
}

/** A line across the picture that stays until it is taken away; none for an empty one. */
export function warn(text) {
  const line = document.getElementById("warning");
  line.textContent = text;
  line.hidden = text === "";
}
