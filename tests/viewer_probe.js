// Runs in the page after the viewer: does what a user does, and leaves what it found in the document.
const different = (a, b) => a.data.reduce((sum, x, i) => sum + (x !== b.data[i]), 0);
const key = (name) => window.dispatchEvent(Object.assign(new KeyboardEvent("keydown", { key: name, cancelable: true })));
const composed = (frame, values, bases = 99) => {
  const { s, z } = frame.transfer.encoded(values);
  frame.composer.compose(frame.transfer.weights(z), s, bases);
  return Array.from(frame.composer.read());
};

async function probe() {
  report.models = asked.models.map(({ packed, values }) => {
    const frame = app.framed(packed);
    const told = values.map((one) => {
      const { s, z } = frame.transfer.encoded(one.flat());
      return frame.transfer.trusted(s, z);
    });
    return { maps: values.map((one) => composed(frame, one.flat())), told };
  });
  report.cut = composed(app.framed(asked.models[0].packed), asked.models[0].values[0].flat(), 3);
  report.measured = asked.measured.map(({ packed, lightings }) => {
    const { measuring } = app.framed(packed);
    return lightings.map((lamps) => Array.from(measuring.measure(lamps)));
  });
  const { bvh } = app.framed(asked.rays.packed).measuring.scene;
  report.occluded = asked.rays.rays.map((ray) => Number(bvh.occluded(...ray)));

  app.set({ lighting: 0, source: "ours", show: "both" });
  const first = await pixels();
  app.set({ source: "error" });
  report.error_differs = different(first, await pixels());
  app.set({ source: "reference" });
  report.reference_differs = different(first, await pixels());
  app.set({ source: "ours", lamps: [{ type: "point", position: [0.2, 0.4, 0.2], intensity: [1, 1, 1] }] });
  report.lighting_after_edit = app.state.lighting;
  const before = await pixels();
  app.view.lamps.gizmo.object.position.x += 0.1; // as a drag does
  app.view.lamps.gizmo.dispatchEvent({ type: "objectChange" });
  report.dragged = app.state.lamps[0].position;
  const moved = await pixels();
  report.moved_differs = different(before, moved);

  app.set({ show: "indirect", bases: 4, exposure: 1.5, albedo: false });
  app.view.look([0.5, 0.3, -0.9], [0.3, 0.25, 0.3]);
  const link = app.link();
  const wanted = await pixels();
  app.set(app.initial);
  app.reset();
  report.reset_differs = different(wanted, await pixels());
  app.restore(link);
  report.link_differs = different(wanted, await pixels());
  report.link_same = app.link() === link;
  const state = JSON.stringify(app.state);
  report.bad_links = asked.bad_links.map((hash) => app.restore(hash) || JSON.stringify(app.state) !== state);
  const warning = document.getElementById("warning");
  const warned = () => [warning.textContent, getComputedStyle(warning).display !== "none"];
  report.warned = warned();
  app.restore(`#${JSON.stringify({ lamps: Array(9).fill(app.initial.lamps[0]) })}`);
  [report.too_many] = warned();
  app.restore("#{}");
  report.followed = warned();
  app.restore(link);

  for (const [name, entry] of [["2", "show"], ["b", "source"], ["s", "lamps"], ["]", "exposure"]]) {
    key(name);
    report[`key ${name}`] = app.state[entry];
  }
  report.tab_lists = document.getElementById("lamps").options.length;
  key("Delete");
  report.after_delete = app.state.lamps.length;
  key("e");
  report.error_refused = app.state.source;

  app.set({ ...app.initial, lamps: asked.drawn.lamps, show: "direct", source: "ours", exposure: 0, lighting: null });
  app.view.look(app.initial.eye, app.initial.target);
  const drawn = await pixels();
  report.drawn = { width: drawn.width, height: drawn.height, data: Array.from(drawn.data) };
  report.fov = app.view.camera.fov;
  app.set({ lamps: [] });
  report.dark = (await pixels()).data.reduce((most, x, i) => Math.max(most, i % 4 === 3 ? 0 : x), 0);
  report.panel = document.getElementById("panel").getBoundingClientRect().width;
  report.wide = document.documentElement.scrollWidth - document.documentElement.clientWidth;
}

probe()
  .catch((error) => window.faults.push(`${error} ${error.stack}`))
  .then(() => {
    const node = document.createElement("p");
    node.id = "probe";
    node.textContent = JSON.stringify({ ...report, faults: window.faults });
    document.body.append(node);
  });
