"""Bakes pairs of direct and indirect lightmaps in Blender's Cycles, as `ddprt import` takes them.

Blender's module wants a Python of its own, so there are two steps; the first stands for whatever made your mesh:

    python datasets/recipes/cycles_pairs.py export FOLDER [--scene cornell] [--resolution 64] [--lightings 24]
    python3.11 -m venv blender && blender/bin/pip install bpy==5.0.1
    blender/bin/python datasets/recipes/cycles_pairs.py bake FOLDER --samples 256
    ddprt import FOLDER --out runs/cycles --geometry room.obj --quantity E/pi
    ddprt run runs/cycles/config.toml

`export` writes room.obj and room.mtl (metres, Y up, flat albedos, lightmap coordinates as `vt`) and lights.csv. `bake` writes
direct/NAME.exr and indirect/NAME.exr as Cycles has them: diffuse light without colour, which is E/pi, linear Rec.709
("Non-Color", so that `save` leaves the numbers alone), with two texels beyond the edge of charts filled. A light of I W/sr
has the power 4 pi I. Settings are those of `cycles_bake.py`: no light tree, clamping, denoising or adaptive sampling.
"""

import argparse
import csv
from pathlib import Path
from typing import Any

import numpy as np

_BOUNCES, _MARGIN = 32, 2


def export(folder: Path, name: str, resolution: int, count: int) -> None:
    """The room, its lightmap coordinates and its lights; runs in ddprt's environment.

    Args:
      folder: made if missing.
      name: library name or file of the scene.
      resolution: texels per side that charts are packed for.
      count: lightings, drawn as the default job draws them.
    """
    import ddprt
    from ddprt.config import load_config
    from ddprt.sampling.lightings import draw_lightings
    from ddprt.scene.atlas import build_atlas
    from ddprt.transport.embree import Tracer

    scene = ddprt.load_scene(name)
    atlas = build_atlas(scene, resolution, 2 * _MARGIN)
    config = load_config(Path(__file__).parents[2] / "configs" / "cornell.toml").lightings
    clearance = Tracer.of(scene).clearance
    drawn = draw_lightings(config, "train", count, bounds=scene.bounds, clearance=clearance, seed=0).lightings
    folder.mkdir(parents=True, exist_ok=True)
    materials = [f"newmtl m{i}\nKd {' '.join(map(str, entry.albedo))}\n" for i, entry in enumerate(scene.materials)]
    (folder / "room.mtl").write_text("".join(materials))
    lines = ["mtllib room.mtl"]
    lines += [f"v {x!r} {y!r} {z!r}" for x, y, z in scene.corners.reshape(-1, 3).tolist()]
    lines += [f"vt {u!r} {1 - v!r}" for u, v in atlas.uv.reshape(-1, 2).tolist()]
    for index, material in enumerate(scene.material.tolist()):
        corner = 3 * index + 1
        lines += [f"usemtl m{material}", "f " + " ".join(f"{corner + k}/{corner + k}" for k in range(3))]
    (folder / "room.obj").write_text("\n".join(lines) + "\n")
    with (folder / "lights.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["name", "type", "x", "y", "z", "r", "g", "b"])
        for index, lighting in enumerate(drawn):
            table.writerows([f"{index:03d}", "point", *light.position, *light.intensity] for light in lighting)  # type: ignore[attr-defined]


def bake(folder: Path, resolution: int, samples: int) -> None:
    """All lightings of lights.csv; runs in Blender's environment.

    Args:
      folder: of `export`.
      resolution: texels per side.
      samples: paths per texel.
    """
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    stage = bpy.context.scene
    stage.world = bpy.data.worlds.new("black")
    stage.world.use_nodes = True
    stage.world.node_tree.nodes["Background"].inputs["Strength"].default_value = 0
    stage.render.engine = "CYCLES"
    cycles = stage.cycles
    cycles.device, cycles.samples = "CPU", samples
    cycles.use_adaptive_sampling = cycles.use_denoising = cycles.use_fast_gi = cycles.use_light_tree = False
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = cycles.light_sampling_threshold = 0
    cycles.max_bounces = cycles.diffuse_bounces = _BOUNCES
    # Axes as they are: Cycles does not care which one is up.
    bpy.ops.wm.obj_import(filepath=str((folder / "room.obj").resolve()), forward_axis="Y", up_axis="Z")
    image = bpy.data.images.new("map", resolution, resolution, alpha=False, float_buffer=True, is_data=True)
    image.colorspace_settings.name = "Non-Color"
    rooms = [entry for entry in bpy.data.objects if entry.type == "MESH"]
    for room in rooms:
        room.select_set(True)
        bpy.context.view_layer.objects.active = room
        for slot in room.material_slots:
            _matt(slot.material, image)
    settings = stage.render.image_settings
    settings.file_format, settings.color_depth, settings.color_mode, settings.exr_codec = "OPEN_EXR", "32", "RGB", "ZIP"
    with (folder / "lights.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        strength = np.array([float(row[channel]) for channel in "rgb"])
        lamp = bpy.data.lights.new("lamp", "POINT")
        lamp.energy, lamp.color = 4 * np.pi * float(strength.max()), (strength / strength.max()).tolist()
        lamp.shadow_soft_size = 0
        holder = bpy.data.objects.new("lamp", lamp)
        holder.location = [float(row[axis]) for axis in "xyz"]
        stage.collection.objects.link(holder)
        for kind in ("direct", "indirect"):
            bpy.ops.object.bake(type="DIFFUSE", pass_filter={kind.upper()}, margin=_MARGIN, use_clear=True)
            path = folder / kind / f"{row['name']}.exr"
            path.parent.mkdir(exist_ok=True)
            image.filepath_raw, image.file_format = str(path.resolve()), "OPEN_EXR"
            image.save()
        bpy.data.objects.remove(holder)
        print(f"lighting {row['name']}", flush=True)


def _matt(material: Any, image: Any) -> None:
    """The albedo of an OBJ's material as a Lambertian surface, and the image that is baked to."""
    albedo = list(material.diffuse_color)
    nodes = material.node_tree.nodes
    for node in nodes:
        if node.type == "BSDF_PRINCIPLED":
            albedo = list(node.inputs["Base Color"].default_value)
    nodes.clear()
    output, diffuse, target = (nodes.new(f"ShaderNode{kind}") for kind in ("OutputMaterial", "BsdfDiffuse", "TexImage"))
    diffuse.inputs["Color"].default_value = albedo
    material.node_tree.links.new(diffuse.outputs[0], output.inputs["Surface"])
    target.image = image
    nodes.active = target


def main() -> None:
    """Reads the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    steps = parser.add_subparsers(dest="step", required=True)
    step = steps.add_parser("export", help="write a room and lights (ddprt's environment)")
    step.add_argument("folder", type=Path)
    step.add_argument("--scene", default="cornell")
    step.add_argument("--resolution", type=int, default=64)
    step.add_argument("--lightings", type=int, default=24)
    step = steps.add_parser("bake", help="bake the pairs (Blender's environment)")
    step.add_argument("folder", type=Path)
    step.add_argument("--resolution", type=int, default=64)
    step.add_argument("--samples", type=int, default=256)
    given = parser.parse_args()
    if given.step == "export":
        export(given.folder, given.scene, given.resolution, given.lightings)
    else:
        bake(given.folder, given.resolution, given.samples)


if __name__ == "__main__":
    main()
