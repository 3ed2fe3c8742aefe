"""Bakes indirect irradiance with Blender's Cycles, and compares it with ddprt's own reference.

Three steps in two environments, since Blender's module wants a Python of its own and ddprt does not depend on it:

    python datasets/recipes/cycles_bake.py export FOLDER [--scene cornell] [--resolution 152] [--lightings FILE]
    python3.11 -m venv blender && blender/bin/pip install bpy==5.0.1
    blender/bin/python datasets/recipes/cycles_bake.py bake FOLDER --samples 64 --runs 2
    python datasets/recipes/cycles_bake.py compare FOLDER

`bake` writes FOLDER/indirect_LIGHTING_SAMPLES_RUN.exr: E in W/m², linear Rec.709, 32-bit floats, row 0 at the top, and no
gutter: texels whose centre no triangle covers are black. `bakes.jsonl` holds the seconds of each (Cycles alone, after a first
bake of one sample) and the time of the cores, which other programs disturb less. Settings: CPU, up to 32 bounces with Cycles'
own roulette, no light tree, Sobol numbers, no adaptive sampling, no clamping, no denoising. What Blender does otherwise:

    Cycles gives E / pi (diffuse, indirect, without colour)      times pi
    lamp power P                                                 P = 4 pi I
    images begin at the bottom row                               v -> 1 - v
    a new world glows                                            its background's strength is set to 0
    diffuse surfaces have two sides, ddprt's backs are black     --one-sided (slower; matters where backs are seen)
    the paths of a texel start near its centre, not all over it  `compare` shows it: the error against the reference, whose
                                                                 texels are area means, is above that of two runs
    a place outside the triangle of the centre is folded back    `compare` takes only texels that are wholly covered, and
                                                                 shows those within one triangle as well
"""

import argparse
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

BOUNCES = 32


def export(folder: Path, name: str, resolution: int, lightings: Path | None) -> None:
    """Writes scene.npz, its atlas and lightings.json; runs in ddprt's environment.

    Args:
      folder: made if missing.
      name: library name or file of the scene.
      resolution: texels per side.
      lightings: JSON list of lightings; None takes the first held-out one of the default job's distribution.
    """
    import ddprt
    from ddprt.config import load_config
    from ddprt.errors import UserError
    from ddprt.lights import lighting_json, load_lightings
    from ddprt.sampling.lightings import draw_lightings
    from ddprt.scene.atlas import build_atlas
    from ddprt.transport.embree import Tracer

    scene = ddprt.load_scene(name)
    if any(material.texture is not None for material in scene.materials):
        raise UserError(f'"{scene.name}": got textures, expected plain albedos; choose another scene')
    atlas = build_atlas(scene, resolution)
    if lightings is None:
        config = load_config(Path(__file__).parents[2] / "configs" / "cornell.toml")
        clearance = Tracer.of(scene).clearance
        chosen = draw_lightings(config.lightings, "test", 1, bounds=scene.bounds, clearance=clearance, seed=0).lightings
    else:
        chosen = tuple(load_lightings(lightings))
    folder.mkdir(parents=True, exist_ok=True)
    pieces = np.unique(np.stack([atlas.piece_texel, atlas.piece_triangle], 1), axis=0)[:, 0]
    np.savez(
        folder / "scene.npz",
        name=name,
        corners=scene.corners,
        uv=atlas.uv,
        material=scene.material,
        albedo=np.array([material.albedo for material in scene.materials]),
        resolution=resolution,
        texel=atlas.texel,
        coverage=atlas.coverage,
        triangles=np.bincount(pieces, minlength=atlas.count),
    )
    (folder / "lightings.json").write_text(json.dumps([lighting_json(lighting) for lighting in chosen], indent=1) + "\n")
    print(f"{name}: {len(scene.triangles)} triangles, {atlas.count} texels, {len(chosen)} lightings in {folder}")


def bake(folder: Path, samples: list[int], runs: int, one_sided: bool) -> None:
    """Bakes every lighting with Cycles; runs in Blender's environment.

    Args:
      folder: of `export`.
      samples: paths per texel.
      runs: bakes of each with other random numbers.
      one_sided: backs of surfaces absorb.
    """
    import bpy

    with np.load(folder / "scene.npz") as stored:
        data = {key: stored[key] for key in stored.files}
    lightings = json.loads((folder / "lightings.json").read_text())
    side = int(data["resolution"])

    bpy.ops.wm.read_factory_settings(use_empty=True)
    stage = bpy.context.scene
    stage.world = bpy.data.worlds.new("black")
    stage.world.use_nodes = True
    stage.world.node_tree.nodes["Background"].inputs["Strength"].default_value = 0  # `world.color` counts for nothing
    stage.render.engine = "CYCLES"
    stage.render.bake.use_selected_to_active = False
    cycles = stage.cycles
    cycles.device = "CPU"
    cycles.use_adaptive_sampling = cycles.use_denoising = cycles.use_fast_gi = False
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = cycles.light_sampling_threshold = 0
    cycles.max_bounces = cycles.diffuse_bounces = BOUNCES
    cycles.use_light_tree, cycles.sampling_pattern = False, "TABULATED_SOBOL"  # each a seventh faster than the default

    image = bpy.data.images.new("indirect", side, side, alpha=False, float_buffer=True, is_data=True)
    image.colorspace_settings.name = "Non-Color"
    room = _mesh(bpy, data, image, one_sided)
    stage.collection.objects.link(room)
    bpy.context.view_layer.objects.active = room
    room.select_set(True)

    pixels = np.empty(side * side * 4, np.float32)

    def render(count: int, seed: int) -> tuple[float, float]:
        cycles.samples, cycles.seed = count, seed
        start, busy = time.perf_counter(), time.process_time()
        bpy.ops.object.bake(type="DIFFUSE", pass_filter={"INDIRECT"}, margin=0, use_clear=True)
        return time.perf_counter() - start, (time.process_time() - busy) / (os.cpu_count() or 1)

    with (folder / "bakes.jsonl").open("a") as journal:
        for index, lighting in enumerate(lightings):
            lamps = [_lamp(bpy, stage, light) for light in lighting]
            render(1, 0)
            for count in samples:
                for run in range(runs):
                    seconds, busy = render(count, 1 + run)
                    image.pixels.foreach_get(pixels)
                    pixels.reshape(-1, 4)[:, :3] *= np.pi
                    image.pixels.foreach_set(pixels)
                    path = folder / f"indirect_{index:03d}_{count}_{run}.exr"
                    _save(bpy, image, path)
                    row = {"file": path.name, "lighting": index, "samples": count, "run": run}
                    row |= {"seconds": round(seconds, 4), "busy": round(busy, 4), "one_sided": one_sided}
                    journal.write(json.dumps({**row, "blender": bpy.app.version_string}) + "\n")
                    journal.flush()
                    print(f"{path.name}: {seconds:.3f} s", flush=True)
            for lamp in lamps:
                bpy.data.objects.remove(lamp)


def _save(bpy: Any, image: Any, path: Path) -> None:
    """32-bit EXR; `image.save` of a Non-Color image leaves values as they are."""
    settings = bpy.context.scene.render.image_settings
    settings.file_format, settings.color_depth, settings.color_mode, settings.exr_codec = "OPEN_EXR", "32", "RGB", "ZIP"
    image.filepath_raw, image.file_format = str(path.resolve()), "OPEN_EXR"
    image.save()


def _mesh(bpy: Any, data: dict[str, Any], image: Any, one_sided: bool) -> Any:
    """Flat triangles with the atlas as their UV map; Y stays up, since Cycles does not care."""
    corners = data["corners"].reshape(-1, 3)
    mesh = bpy.data.meshes.new("scene")
    mesh.from_pydata(corners.tolist(), [], np.arange(len(corners)).reshape(-1, 3).tolist())
    layer = mesh.uv_layers.new(name="atlas")
    layer.data.foreach_set("uv", (data["uv"].reshape(-1, 2) * [1, -1] + [0, 1]).astype(np.float32).ravel())
    for index, albedo in enumerate(data["albedo"]):
        mesh.materials.append(_material(bpy, f"material {index}", albedo, image, one_sided))
    mesh.polygons.foreach_set("material_index", data["material"].astype(np.int32))
    mesh.update()
    return bpy.data.objects.new("scene", mesh)


def _material(bpy: Any, name: str, albedo: np.ndarray, image: Any, one_sided: bool) -> Any:
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    output, diffuse = nodes.new("ShaderNodeOutputMaterial"), nodes.new("ShaderNodeBsdfDiffuse")
    diffuse.inputs["Color"].default_value = (*albedo.tolist(), 1)
    surface = diffuse.outputs[0]
    if one_sided:
        back, which, mixed = (nodes.new(f"ShaderNode{kind}") for kind in ("BsdfDiffuse", "NewGeometry", "MixShader"))
        back.inputs["Color"].default_value = (0, 0, 0, 1)
        links.new(which.outputs["Backfacing"], mixed.inputs[0])
        links.new(surface, mixed.inputs[1])
        links.new(back.outputs[0], mixed.inputs[2])
        surface = mixed.outputs[0]
    links.new(surface, output.inputs["Surface"])
    target = nodes.new("ShaderNodeTexImage")
    target.image = image
    nodes.active = target
    return material


def _lamp(bpy: Any, stage: Any, light: dict[str, Any]) -> Any:
    """A light in Blender's words."""
    from mathutils import Vector

    if light["type"] == "point":
        lamp = bpy.data.lights.new("lamp", "POINT")
        strength, lamp.shadow_soft_size = 4 * np.pi * np.array(light["intensity"]), 0
    elif light["type"] == "directional":
        lamp = bpy.data.lights.new("lamp", "SUN")
        strength, lamp.angle = np.array(light["irradiance"]), 0
    else:
        sys.exit(f"error: got a {light['type']} light, expected point or directional")
    lamp.energy = float(strength.max())
    lamp.color = (strength / max(strength.max(), 1e-300)).tolist()
    holder = bpy.data.objects.new("lamp", lamp)
    stage.collection.objects.link(holder)
    if light["type"] == "point":
        holder.location = light["position"]
    else:
        holder.rotation_euler = Vector(light["direction"]).to_track_quat("-Z", "Y").to_euler()
    bpy.context.view_layer.update()
    return holder


def compare(folder: Path, paths: int) -> None:
    """Means and errors against ddprt's path tracer; runs in ddprt's environment.

    Args:
      folder: of `bake`.
      paths: per texel of the reference; its own noise is taken out of the errors.
    """
    import ddprt
    from ddprt.lights import load_lightings
    from ddprt.scene.atlas import build_atlas
    from ddprt.scene.exr import read_exr
    from ddprt.transport.embree import Tracer
    from ddprt.transport.reference import on_texels, trace_reference

    with np.load(folder / "scene.npz") as stored:
        data = {key: stored[key] for key in stored.files}
    scene = ddprt.load_scene(str(data["name"]))
    atlas, tracer = build_atlas(scene, int(data["resolution"])), Tracer.of(scene)
    if not np.array_equal(atlas.texel, data["texel"]):
        sys.exit("error: the atlas is not the one that was exported; export again")
    whole = np.flatnonzero(data["coverage"] > 1 - 1e-6)
    single = data["triangles"][whole] == 1
    last = {}
    for line in (folder / "bakes.jsonl").read_text().splitlines():
        row = json.loads(line)
        last[row["file"]] = row
    for index, lighting in enumerate(load_lightings(folder / "lightings.json")):
        rows = [row for row in last.values() if row["lighting"] == index]
        if not rows:
            continue
        truth = trace_reference(tracer, scene, lighting, on_texels(tracer, atlas, whole), len(whole), paths, seed=index)
        mean, variance = truth.indirect.mean(), truth.indirect_variance
        known = np.sqrt(variance.sum(0).mean()) / len(whole) / mean
        grain = np.sqrt(variance.mean()) / mean
        print(f"lighting {index}: {len(whole)} wholly covered texels of {atlas.count}, {single.sum()} in one triangle")
        print(f"reference: {paths} paths, mean {mean:.5f} +- {mean * known:.5f}, relative RMSE {grain:.4f}")
        print("samples  seconds  cores' time / cores  mean/reference - 1  RMSE/mean  the same, one triangle  two runs")
        for samples in sorted({row["samples"] for row in rows}):
            same = [row for row in rows if row["samples"] == samples]
            maps = [read_exr(folder / row["file"])[0].reshape(-1, 3)[atlas.texel[whole]].astype(float) for row in same]
            off = np.mean([image.mean() for image in maps]) / mean - 1
            squared = np.mean([(image - truth.indirect) ** 2 for image in maps], 0) - variance
            error, inner = (np.sqrt(max(part.mean(), 0)) / mean for part in (squared, squared[single]))
            noise = np.sqrt(np.var(maps, axis=0, ddof=1).mean()) / mean if len(maps) > 1 else np.nan
            seconds, busy = (np.median([row[key] for row in same]) for key in ("seconds", "busy"))
            times = f"{samples:7d}  {seconds:7.3f}  {busy:19.3f}"
            print(f"{times}  {off:+18.4f}  {error:9.4f}  {inner:22.4f}  {noise:8.4f}", flush=True)


def main() -> None:
    """Reads the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    steps = parser.add_subparsers(dest="step", required=True)
    step = steps.add_parser("export", help="write the scene (ddprt's environment)")
    step.add_argument("folder", type=Path)
    step.add_argument("--scene", default="cornell")
    step.add_argument("--resolution", type=int, default=152)
    step.add_argument("--lightings", type=Path)
    step = steps.add_parser("bake", help="bake it with Cycles (Blender's environment)")
    step.add_argument("folder", type=Path)
    step.add_argument("--samples", type=int, nargs="+", default=[64, 256])
    step.add_argument("--runs", type=int, default=2)
    step.add_argument("--one-sided", action="store_true")
    step = steps.add_parser("compare", help="against ddprt's reference (ddprt's environment)")
    step.add_argument("folder", type=Path)
    step.add_argument("--paths", type=int, default=512)
    given = parser.parse_args()
    if given.step == "export":
        export(given.folder, given.scene, given.resolution, given.lightings)
    elif given.step == "bake":
        bake(given.folder, given.samples, given.runs, given.one_sided)
    else:
        compare(given.folder, given.paths)


if __name__ == "__main__":
    main()
