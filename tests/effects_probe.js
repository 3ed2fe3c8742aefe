// Runs in the page after the viewer: what it shows of own lamps and of held-out lightings.
const half = (x) => {
  const [sign, exponent, part] = [x & 0x8000 ? -1 : 1, (x >> 10) & 31, x & 1023];
  return sign * (exponent === 0 ? part * 2 ** -24 : (1 + part / 1024) * 2 ** (exponent - 15));
};
const composed = () => Array.from(app.frame.composer.read());

const middle = (map) => {
  const lit = map.filter((x, i) => i % 4 < 3 && x > 0);
  return Math.log2((0.3 * Math.PI * lit.length) / lit.reduce((sum, x) => sum + x, 0));
};
const shot = async (changes, exposure) => {
  app.set({ ...changes, exposure });
  return { ...(await pixels()), exposure: app.state.exposure };
};

async function probe() {
  const { stored } = app.model;
  app.set({ lighting: null, lamps: asked.lamps, show: "both", source: "ours", albedo: false });
  report.measured = Array.from(app.frame.values);
  report.own = composed();
  app.expose();
  report.both = await shot({}, app.state.exposure);
  report.fov = app.view.camera.fov;
  report.notes = Array.from(document.querySelectorAll("#notes li"), (line) => line.textContent);
  report.stored = stored.map((_, lighting) => {
    app.set({ lighting });
    return { map: composed(), said: document.getElementById("error-told").textContent, lamps: app.state.lamps.length };
  });
  report.truth = Array.from(stored[0].indirect, half);
  report.reference = await shot({ lighting: 0, source: "reference", show: "indirect" }, middle(report.truth));
  report.error = await shot({ source: "error" }, 0);
  report.ours = composed();
  const last = stored.length - 1;
  report.laid = Array.from(stored[last].direct, half);
  report.spread = await shot({ lighting: last, source: "ours", show: "direct" }, middle(report.laid));
}

probe()
  .catch((error) => window.faults.push(`${error} ${error.stack}`))
  .then(() => {
    const node = document.createElement("p");
    node.id = "probe";
    node.textContent = JSON.stringify({ ...report, faults: window.faults });
    document.body.append(node);
  });
