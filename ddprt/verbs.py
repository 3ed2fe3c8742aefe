"""The verbs of the command line: what each does with what was typed. Imports stay inside them, so that help is instant."""

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ddprt.errors import UserError


@dataclass
class Call:
    """What was typed after the verb."""

    verb: str
    files: list[str] = field(default_factory=list)
    options: dict[str, str] = field(default_factory=dict)
    overrides: dict[str, str] = field(default_factory=dict)
    command: str = ""

    @property
    def quiet(self) -> bool:
        """Whether progress is hidden."""
        return "quiet" in self.options

    def asks(self, flag: str) -> bool:
        """Whether a flag was given."""
        return flag in self.options

    def file(self, what: str) -> str:
        """The one file argument."""
        if len(self.files) != 1:
            raise UserError(f"ddprt {self.verb}: got {len(self.files)} files, expected {what}; see `ddprt {self.verb} --help`")
        return self.files[0]

    def run(self) -> Any:
        """The run folder and configuration that the arguments mean."""
        from ddprt.config import load_config
        from ddprt.pipeline import Run

        source = self.file("a configuration such as configs/cornell.toml")
        if _is_scene(source):
            raise UserError(
                f"ddprt {self.verb}: got the scene {source}, expected a configuration; "
                f"write ddprt {self.verb} configs/cornell.toml --scene.name {source}"
            )
        config = load_config(source, self.overrides)
        default = Path(source).parent if Path(source).name == "config.toml" else Path("runs") / Path(source).stem
        return Run(config, Path(self.options.get("out") or default), command=self.command, quiet=self.quiet)


def _is_scene(source: str) -> bool:
    """Whether a scene stands where a configuration should."""
    from ddprt.scene.files import SUFFIXES
    from ddprt.scene.library import SCENES

    return Path(source).suffix.lower() in SUFFIXES or (source in SCENES and not Path(source).is_file())


def run(call: Call) -> None:
    """bake, fit, evaluate, report and export"""
    for what, path in call.run().all().items():
        print(f"{what + ':':<10}{path}")


def inspect(call: Call) -> None:
    """what a scene is, what light it calls for, and what a bake would do"""
    from ddprt.pipeline_inspect import describe

    print(describe(call.file("a configuration, a scene name or a mesh"), call.overrides))


def bake(call: Call) -> None:
    """render the dataset of direct and indirect lightmaps"""
    job = call.run()
    if call.asks("dry-run"):
        print(job.forecast())
        return
    data = job.bake()
    job.record(data)
    print(f"dataset:  {data.folder}")


def fit(call: Call) -> None:
    """learn a model from a baked dataset"""
    job = call.run()
    job.fit(job.dataset())
    print(f"model:    {job.folder / 'model.ddprt'}")


def evaluate(call: Call) -> None:
    """score all methods on held-out lightings and write the report"""
    job = call.run()
    data = job.dataset(shines=True)
    models, seconds = job.fit(data)
    evaluation = job.evaluate(data, models, seconds)
    budget = job.budget(data, models) if call.asks("budget") else None
    report = job.report(data, models, evaluation, budget=budget)
    if budget is not None:
        from ddprt.bench.budget.budget import table

        print(f"{table(budget)}\nbudget:   {job.folder / 'budget.json'}")
    print(f"metrics:  {job.folder / 'metrics.json'}\nreport:   {report}")


def bench(call: Call) -> None:
    """try settings about a configuration: error against seconds, bytes and memory"""
    asked = [f"--{flag}" for flag in ("peers", "effects", "methods") if call.asks(flag)]
    asked += ["--leagues or --splits"] * (call.asks("leagues") or call.asks("splits"))
    if len(asked) > 1:
        raise UserError(f"ddprt bench: got {' and '.join(asked)}, expected one of them; run it once for each")
    if call.asks("methods"):
        if given := [*call.files, *(f"--{key}" for key in (*call.overrides, *call.options) if key not in ("methods", "quiet"))]:
            raise UserError(f"ddprt bench: got --methods and {given[0]}, expected --methods alone; it lists what is installed")
        from ddprt.methods.listing import table

        print(table())
        return None
    if call.asks("peers"):
        return peers(call)
    if call.asks("leagues") or call.asks("splits"):
        return leagues(call)
    if call.asks("quick"):
        raise UserError("--quick: got no --peers, which it belongs to; a sweep is shortened by --sweep.SECTION.KEY")
    if call.asks("effects"):
        if swept := [key for key in call.overrides if key.partition(".")[0] == "sweep"]:
            raise UserError(f"--{swept[0]}: got --effects, which sweeps nothing, expected one of them; run it once for each")
        job = call.run()
        print(f"{job.ablate()}\nresults:  {job.folder / 'bench' / 'effects.jsonl'}")
        return None
    results, page, *others = call.run().sweep()
    print(f"results:  {results}\npage:     {page}\nfigures:  {others[-1].parent}")
    return None


def leagues(call: Call) -> None:
    """Methods under the same budgets, and on lightings unlike those of training."""
    from ddprt.bench.leagues.generalisation import Generalisation, markdown, told
    from ddprt.bench.leagues.leagues import leagues
    from ddprt.bench.leagues.splits import split_names
    from ddprt.files import write_text

    names = split_names(call.options["splits"]) if call.asks("splits") else []
    job = call.run()
    data, folder, found = job.bake(), job.folder / "bench", []
    if names:
        found = told(Generalisation(job.config, data, job.scene, folder, job.progress).run(names), names)
        write_text(folder / "splits.md", markdown(found, job.config.scene.name))
        print(f"splits:   {folder / 'splits.md'}")
    if call.asks("leagues"):
        results, table, page = leagues(job.config, data, job.scene, folder, job.progress, splits=found)[1]
        print(f"results:  {results}\ntable:    {table}\npage:     {page}")


def peers(call: Call) -> None:
    """Our fit, transfer and relighting beside everyone else's."""
    from ddprt.bench.peers.peers import peers, table
    from ddprt.config import load_config
    from ddprt.files import make_folder, write_text
    from ddprt.progress import Progress

    config = load_config(call.file("a configuration, or nothing") if call.files else None, call.overrides)
    record = peers(config, Progress(call.quiet), quick=call.asks("quick"))
    print(table(record))
    if "out" in call.options:
        import json

        folder = Path(call.options["out"])
        make_folder(folder)
        write_text(folder / "peers.json", json.dumps(record, indent=1, allow_nan=False) + "\n")
        print(f"record:   {folder / 'peers.json'}")


def tune(call: Call) -> None:
    """find the setting that meets a budget of error, time and bytes, with few trials"""
    from ddprt.bench.tune.search import told

    call.overrides |= {f"tune.{key.replace('-', '_')}": call.options[key] for key in _LIMITS if key in call.options}
    job = call.run()
    outcome = job.tune()
    print(told(outcome))
    if not outcome.met:
        if outcome.doubt:
            limit, what = outcome.doubt.quantity, f"that cannot be shown to be met, {outcome.doubt.quantity} is in doubt"
        else:
            limit, what = outcome.binding, f"that no setting meets, {outcome.binding} stands in the way"
        raise UserError(
            f"ddprt tune: got a budget {what}; "
            f"raise --max-{limit.replace('_', '-')}, or take {job.folder / 'tune' / 'nearest.toml'}"
        )
    print(f"config:   {job.folder / 'tune' / 'tuned.toml'}")


def relight(call: Call) -> None:
    """turn a lighting into an indirect lightmap: ddprt relight MODEL --lighting lights.json --out relit.exr"""
    import json

    from ddprt.lights import load_lightings, parse_lighting, scene_lights
    from ddprt.methods.method import STATUSES
    from ddprt.runtime.model_file import load_model
    from ddprt.scene.exr import write_exr

    source, out = call.options.get("lighting"), Path(call.options.get("out", "relit.exr"))
    if source is None:
        raise UserError(
            'ddprt relight: got no --lighting, expected a JSON file or text such as [{"type": "point", ...}]; add it'
        )
    if out.suffix != ".exr":
        raise UserError(f"--out: got {out}, expected a path that ends in .exr; name it so")
    model = load_model(call.file("a model folder such as runs/cornell/model.ddprt"))
    if source.lstrip().startswith(("[", "{")):
        try:
            records = json.loads(source)
            several = isinstance(records, list) and bool(records) and isinstance(records[0], list)
            lightings = [parse_lighting(entry, "--lighting") for entry in (records if several else [records])]
        except (json.JSONDecodeError, RecursionError) as error:
            raise UserError(
                f'--lighting: got text that is not JSON ({error}), expected [{{"type": "point", ...}}] or the like; mend it'
            ) from None
    elif Path(source).suffix.lower() in (".glb", ".gltf"):
        lightings = [scene_lights(source)]
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


def export(call: Call) -> None:
    """write textures, matrices or a network, a shader and a manifest for engines"""
    from ddprt.runtime.model_file import load_model

    job = call.run()
    job.export(load_model(job.folder / "model.ddprt"))
    print(f"textures: {job.folder / 'export'}")


def view(call: Call) -> None:
    """show a model in the browser, lamps to be dragged: ddprt view MODEL, or --html FILE.html for a page of its own"""
    from ddprt.dataset.store import open_dataset
    from ddprt.export.viewer.pack import pack
    from ddprt.export.viewer.page import page
    from ddprt.export.viewer.serve import serve
    from ddprt.files import write_text
    from ddprt.runtime.model_file import load_model

    out, port = call.options.get("html"), call.options.get("port", "0")
    if out is not None and Path(out).suffix not in (".html", ".htm"):
        raise UserError(f"--html: got {out}, expected a path that ends in .html; name it so")
    if not (port.isascii() and port.isdigit() and int(port) < 1 << 16):
        raise UserError(f"--port: got {port}, expected a whole number from 0 to 65535; 0 takes a free one")
    folder = Path(call.file("a model folder such as runs/cornell/model.ddprt"))
    model = load_model(folder / "model.ddprt" if (folder / "model.ddprt").is_dir() else folder)
    data = open_dataset(call.options["dataset"]) if call.asks("dataset") else None
    made = page(pack(model, data))
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
    description, manifest = read_description(folder), Manifest(folder)
    faults = manifest.damaged()
    faults += [f"{name}: not baked yet" for name in expected_files(description) if name not in manifest.entries]
    if faults:
        for fault in faults:
            print(fault)
        raise UserError(
            f"{folder}: got {len(faults)} faulty files of {len(expected_files(description))}; "
            "delete the damaged ones and run the bake again to make them anew"
        )
    print(f"{folder}: {len(manifest.entries)} files whole")


def doctor(call: Call) -> None:
    """check that everything ddprt needs works on this machine"""
    from ddprt.pipeline_inspect import checkup

    lines, fine = checkup()
    print(lines)
    if not fine:
        raise UserError("doctor: got parts that are missing or broken, expected all to work; mend what is marked above")


@dataclass(frozen=True)
class Verb:
    """One verb: its code, what it works on, its own options and flags, and whether it takes --section.key overrides."""

    work: Callable[[Call], None]
    file: str = "FILE.toml"
    options: dict[str, str] = field(default_factory=dict)
    flags: dict[str, str] = field(default_factory=dict)
    configured: bool = True


_OUT = {"out": "DIR  folder of the run (default: runs/NAME)"}
_LIMITS = {
    "max-relative-rmse": "X  most error on held-out lightings",
    "max-frame-us": "X  most microseconds to relight a frame",
    "max-megabytes": "X  most 10^6 bytes that ship",
    "max-bake-seconds": "X  most seconds to bake what is learned from",
    "max-fit-seconds": "X  most seconds to fit",
}
VERBS = {
    "run": Verb(run, options=_OUT),
    "inspect": Verb(inspect, "FILE.toml|SCENE|MESH"),
    "bake": Verb(bake, options=_OUT, flags={"dry-run": "tell seconds, rays, files and memory beforehand; writes nothing"}),
    "fit": Verb(fit, options=_OUT),
    "eval": Verb(
        evaluate, options=_OUT, flags={"budget": "  take the error apart by its causes (section [budget]); bakes more"}
    ),
    "bench": Verb(
        bench,
        options=_OUT | {"splits": "NAMES  train on one thing, ask about another: kind,outside,... or all (docs/leagues.md)"},
        flags={
            "peers": "compare fit, transfer and relighting with other libraries; FILE may be left out",
            "methods": "list all methods, those of other packages too, with their settings; no FILE",
            "leagues": "methods under equal budgets of bytes, operations and seconds, tuned alike (section [leagues])",
            "effects": "what each effect that is called for changes in light, seconds and rays",
            "quick": "less of it",
        },
    ),
    "tune": Verb(tune, options=_OUT | _LIMITS),
    "relight": Verb(
        relight,
        "MODEL",
        {"lighting": "FILE|JSON  a list of lightings, or one as text", "out": "FILE.exr  where to (default: relit.exr)"},
        configured=False,
    ),
    "export": Verb(export, options=_OUT),
    "view": Verb(
        view,
        "MODEL",
        {
            "html": "FILE.html  write one file that opens from disk, and serve nothing",
            "dataset": "DIR  held-out lightings with their references and errors",
            "port": "N  of the address on this machine (default: a free one)",
        },
        {"no-open": "open no browser"},
        configured=False,
    ),
    "verify": Verb(verify, "DIR", configured=False),
    "doctor": Verb(doctor, "", configured=False),
}
LATER = {"import", "status"}
