"""Verbs that need no configuration: they work on models, datasets and what others rendered.

Imports stay inside them, so that help is instant.
"""

import sys
from pathlib import Path
from typing import Any, cast, get_args

from ddprt.call import Call
from ddprt.errors import UserError


def import_(call: Call) -> None:
    """make a dataset of what others rendered or photographed"""
    from ddprt.config import checked
    from ddprt.dataset.importers.importing import import_dataset
    from ddprt.dataset.importers.recipe import load_recipe
    from ddprt.files import make_folder, write_text
    from ddprt.progress import Progress
    from ddprt.scene.files import IMPORTED

    source, given = Path(call.file("a folder of pictures, or a TOML recipe")), dict(call.options)
    out, quiet = Path(given.pop("out", "") or Path("runs") / source.resolve().stem), given.pop("quiet", None) is not None
    given |= {"clip": "true"} if "clip" in given else {}
    recipe, folder, found = load_recipe(source, given)
    progress = Progress(quiet)
    for line in found:
        progress.say(f"found: {line}")
    make_folder(out)
    data = import_dataset(recipe, folder, out / "dataset", progress)
    sizes = {name: len(data.split(name)) for name in ("train", "validation", "test")}
    document = {"scene": {"name": IMPORTED}, "lightings": sizes, "points": {"count": len(data.samples.position)}}
    write_text(out / "import.toml", recipe.to_toml())
    if not (out / "config.toml").exists():  # what was changed in it since stays
        write_text(out / "config.toml", checked({**document, "seed": recipe.seed}).to_toml())
    print(f"dataset:  {data.folder}\nconfig:   {out / 'config.toml'}")


def relight(call: Call) -> None:
    """turn a lighting into an indirect lightmap: ddprt relight MODEL --lighting lights.json --out relit.exr"""
    import json

    from ddprt.lights import Units, load_lightings, parse_lighting, scene_lights
    from ddprt.methods.method import STATUSES
    from ddprt.scene.exr import write_exr

    source, out = call.options.get("lighting"), Path(call.options.get("out", "relit.exr"))
    if source is None:
        raise UserError(
            'ddprt relight: got no --lighting, expected a JSON file or text such as [{"type": "point", ...}]; add it'
        )
    if out.suffix != ".exr":
        raise UserError(f"--out: got {out}, expected a path that ends in .exr; name it so")
    is_gltf, units = Path(source).suffix.lower() in (".glb", ".gltf"), call.options.get("units", "photometric")
    if units not in get_args(Units):
        raise UserError(f'--units: got "{units}", expected {" or ".join(get_args(Units))}; mend it')
    if call.asks("units") and not is_gltf:
        raise UserError(f"--units: got {units} for lights of ddprt's own list, which are in W/sr, W/m²; leave it out")
    model = _model_at(call, call.file("a model folder such as runs/cornell/model.ddprt"))
    if source.lstrip().startswith(("[", "{")):
        try:
            records = json.loads(source)
            several = isinstance(records, list) and bool(records) and isinstance(records[0], list)
            lightings = [parse_lighting(entry, "--lighting") for entry in (records if several else [records])]
        except (json.JSONDecodeError, RecursionError) as error:
            raise UserError(
                f'--lighting: got text that is not JSON ({error}), expected [{{"type": "point", ...}}] or the like; mend it'
            ) from None
    elif is_gltf:
        lightings = [scene_lights(source, cast("Units", units))]
    else:
        lightings = load_lightings(source)
    for index, lighting in enumerate(lightings):
        path = out if len(lightings) == 1 else out.with_stem(f"{out.stem}_{index:03d}")
        measured = model.measure(lighting)
        image, trust = model.image(model.predict(measured, lightings=lighting)), model.trust(measured)
        if not image.any():
            print(
                f"warning: lighting {index} lights no measurement point, so {path} is black; its lamps may stand "
                "inside a solid, outside the scene, face away or have no intensity",
                file=sys.stderr,
            )
        write_exr(path, image)
        print(f"lightmap: {path}")
        if trust is None or not measured.any():
            continue
        print(f"trust:    {trust.score:.2f}, an expected error of {1 - trust.score:.0%}")
        if trust.extrapolating:
            print(f"warning: lighting {index}: extrapolating: {STATUSES['extrapolating']}", file=sys.stderr)


def _model_at(call: Call, folder: str | Path) -> Any:
    """The model of its folder or of a run's; of what moves, at the time of --time in seconds."""
    from ddprt.runtime.animated_file import is_animated, load_animated
    from ddprt.runtime.model_file import load_model

    within = Path(folder) / "model.ddprt"
    folder = within if within.is_dir() else folder
    time = call.options.get("time")
    if is_animated(folder) != (time is not None):
        moves = "an animation and no --time, expected seconds" if time is None else "--time and a model that stands still"
        raise UserError(f"ddprt {call.verb}: got {moves}; {'add it' if time is None else 'leave it out'}")
    if time is None:
        return load_model(folder)
    try:
        seconds = float(time)
    except ValueError:
        raise UserError(f"--time: got {time}, expected seconds; give a number") from None
    return load_animated(folder).at(seconds)


def view(call: Call) -> None:
    """show a model in the browser, lamps to be dragged: ddprt view MODEL, or --html FILE.html for a page of its own"""
    from ddprt.dataset.store import open_dataset
    from ddprt.export.viewer.pack import pack
    from ddprt.export.viewer.page import page
    from ddprt.export.viewer.serve import serve
    from ddprt.files import write_text

    out, port = call.options.get("html"), call.options.get("port", "0")
    if out is not None and Path(out).suffix not in (".html", ".htm"):
        raise UserError(f"--html: got {out}, expected a path that ends in .html; name it so")
    if not (port.isascii() and port.isdigit() and int(port) < 1 << 16):
        raise UserError(f"--port: got {port}, expected a whole number from 0 to 65535; 0 takes a free one")
    if call.asks("time") and call.asks("dataset"):
        raise UserError("--dataset: got one beside --time, expected none: a pose has other texels than its model; leave it out")
    model = _model_at(call, call.file("a model folder such as runs/cornell/model.ddprt"))
    data = open_dataset(call.options["dataset"]) if call.asks("dataset") else None
    packed = pack(model, data)
    if call.asks("time"):
        packed["notes"].insert(0, f"Of what moves, the pose at {float(call.options['time']):g} s is shown.")
    made = page(packed)
    if out is None:
        serve(made, int(port), browse=not call.asks("no-open"))
        return
    write_text(Path(out), made)
    print(f"viewer:   {out}")


def verify(call: Call) -> None:
    """find damaged or missing files of a dataset"""
    from ddprt.dataset.manifest import Manifest
    from ddprt.dataset.store import expected_files, read_description

    folder = Path(call.file("a dataset or a run folder"))
    folder = folder / "dataset" if (folder / "dataset").is_dir() else folder
    poses = [] if (folder / "dataset.json").exists() else sorted(path.parent for path in folder.glob("*-*/dataset.json"))
    damaged, expected, whole = list[str](), 0, list[str]()
    for part in poses or [folder]:
        description, manifest = read_description(part), Manifest(part)
        names = expected_files(description)
        faults = manifest.damaged()
        faults += [f"{name}: not baked yet" for name in names if name not in manifest.entries]
        damaged += [f"{part.name}/{fault}" if poses else fault for fault in faults]
        expected += len(names)
        whole.append(f"{part}: {len(manifest.entries)} files whole")
    if damaged:
        print("\n".join(damaged))
        raise UserError(
            f"{folder}: got {len(damaged)} faulty files of {expected}; "
            "delete the damaged ones and run the bake again to make them anew"
        )
    print("\n".join(whole))


def doctor(call: Call) -> None:
    """check that everything ddprt needs works on this machine"""
    from ddprt.pipeline_inspect import checkup

    lines, fine = checkup()
    print(lines)
    if not fine:
        raise UserError("doctor: got parts that are missing or broken, expected all to work; mend what is marked above")
