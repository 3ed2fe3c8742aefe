"""The verbs of the command line: what each does with what was typed. Imports stay inside them, so that help is instant."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from ddprt.call import Call
from ddprt.errors import UserError
from ddprt.verbs_alone import doctor, import_, relight, verify, view


def run(call: Call) -> None:
    """bake, fit, evaluate, report and export"""
    for what, path in call.run().all().items():
        print(f"{what + ':':<10}{path}")


def inspect(call: Call) -> None:
    """what a scene is, what light it calls for, and what a bake would do"""
    from ddprt.pipeline_inspect import examine

    source, html = call.file("a configuration, a scene name or a mesh"), call.options.get("html")
    if html is not None and Path(html).suffix.lower() not in (".html", ".htm"):
        raise UserError(f"--html: got {html}, expected a path that ends in .html; name it so")
    found = examine(source, call.overrides)
    print(found.text)
    if html is None and not call.asks("open"):
        return
    from tempfile import mkdtemp

    from ddprt.files import write_text

    page = Path(html or Path(mkdtemp(prefix="ddprt-")) / "inspect.html")
    write_text(page, found.page())
    print(f"page        {page}")
    if call.asks("open"):
        import webbrowser

        webbrowser.open(page.absolute().as_uri())


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
    take_apart = job.budget if call.asks("budget") else None  # what moves has none, which is told before the work
    data = job.dataset(shines=True)
    models, seconds = job.fit(data)
    evaluation = job.evaluate(data, models, seconds)
    budget = None if take_apart is None else take_apart(data, models)
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
    if call.asks("quick"):
        raise UserError("--quick: got no --peers, which it belongs to; a sweep is shortened by --sweep.SECTION.KEY")
    if asked and (swept := [key for key in call.overrides if key.partition(".")[0] == "sweep"]):
        raise UserError(f"--{swept[0]}: got {asked[0]}, which sweeps nothing, expected one of them; run it once for each")
    if call.asks("leagues") or call.asks("splits"):
        return leagues(call)
    if call.asks("effects"):
        job = call.run()
        print(f"{job.ablate()}\nresults:  {job.folder / 'bench' / 'effects.jsonl'}")
        return None
    results, page, *others = call.run().sweep()
    print(f"results:  {results}\npage:     {page}\nfigures:  {others[-1].parent}")
    return None


def leagues(call: Call) -> None:
    """Methods under the same budgets, and on lightings unlike those of training."""
    from ddprt.bench.leagues.generalisation import Generalisation
    from ddprt.bench.leagues.leagues import leagues
    from ddprt.bench.leagues.split_pages import told, write_splits
    from ddprt.bench.leagues.splits import split_names

    names = split_names(call.options["splits"]) if call.asks("splits") else []
    job = call.run()
    scene = job.scene  # what moves has none, which is told before the bake
    data, folder, found = job.bake(), job.folder / "bench", []
    if names:
        found = told(Generalisation(job.config, data, scene, folder, job.progress).run(names), names)
        print(f"splits:   {write_splits(folder, found, job.config.scene.name)}")
    if call.asks("leagues"):
        results, table, page = leagues(job.config, data, scene, folder, job.progress, splits=found)[1]
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


def export(call: Call) -> None:
    """write textures, matrices or a network, a shader and a manifest for engines"""
    import json

    from ddprt.export.engines.listing import ENGINES
    from ddprt.runtime.animated_file import is_animated, load_animated
    from ddprt.runtime.model_file import load_model

    if call.asks("engines"):
        names = [name.strip() for name in call.options["engines"].split(",")]
        call.overrides["export.engines"] = json.dumps(list(ENGINES) if names == ["all"] else names)
    if call.asks("gltf"):
        call.overrides["export.gltf"] = "true"
    job = call.run()
    table = job.format_table if call.asks("table") else None  # as in `evaluate`
    folder = job.folder / "model.ddprt"
    model = load_animated(folder) if is_animated(folder) else load_model(folder)
    job.export(model)
    print(f"textures: {job.folder / 'export'}")
    if table is not None:
        print(f"{table(model)}\ntable:    {job.folder / 'export' / 'formats.json'}")


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
_SOURCES = {
    "indirect": "'indirect/*.exr'  pictures to learn; the star stands for the name of the lighting",
    "direct": "'direct/*.exr'  pictures of direct light",
    "measured": "FILE  measured values, .npy, .npz or .csv, (lightings, points, 3), in place of direct light",
    "lights": "FILE  .csv or .json table of lights, or an .lp file and its photographs",
    "channels": "LAYER|R,G,B  of an EXR with several, wildcards allowed",
    "direct-channels": "LAYER|R,G,B  of direct light alone",
    "indirect-channels": "LAYER|R,G,B  of indirect light alone",
    "colour": "NAME  colour space (default: auto, what the files say)",
    "quantity": "NAME  irradiance, E/pi, radiosity, radiance or exitant (default: auto)",
    "albedo": "FILE  of every texel",
    "mask": "FILE  texels that count, above 0",
    "position": "FILE  of every texel, metres",
    "normal": "FILE  of every texel",
    "area": "FILE  of every texel, m²",
    "geometry": "FILE  .glb, .gltf or .obj with lightmap coordinates, metres, Y up",
    "points": "N|FILE.json  texels of the direct maps to measure (default: 128)",
    "measure": "texels|ball  direct light at texels, or a white ball under the lights",
    "test": "X  share of lightings that are held out (default: 0.2)",
    "validation": "X  share that learned methods stop on (default: 0.1)",
    "seed": "N  of the split and the points",
    "name": "NAME  of the scene in reports",
}
VERBS = {
    "run": Verb(run, options=_OUT),
    "inspect": Verb(
        inspect,
        "FILE.toml|SCENE|MESH",
        {"html": "FILE.html  write what is found as a page, with pictures of texels, charts and normals"},
        {"open": "the same in the browser"},
    ),
    "bake": Verb(bake, options=_OUT, flags={"dry-run": "tell seconds, rays, files and memory beforehand; writes nothing"}),
    "import": Verb(
        import_, "DIR|FILE.toml", _OUT | _SOURCES, {"clip": "cut negative light off instead of refusing it"}, configured=False
    ),
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
        {
            "lighting": "FILE|JSON  a list of lightings, one as text, or a glTF file, all of whose lights shine",
            "units": "photometric|radiometric  of a glTF file's lights: candela and lux (default), or W/sr and W/m²",
            "out": "FILE.exr  where to (default: relit.exr)",
            "time": "SECONDS  when, for a model of an animation",
        },
        configured=False,
    ),
    "export": Verb(
        export,
        options=_OUT | {"engines": "NAMES  folders of engines: unity, unreal, godot, three, c, or all (docs/engines.md)"},
        flags={
            "table": "   error against bytes of every format of textures (docs/export.md)",
            "gltf": "   the scene as scene.glb, with the lightmap's coordinates (docs/engines.md)",
        },
    ),
    "view": Verb(
        view,
        "MODEL",
        {
            "html": "FILE.html  write one file that opens from disk, and serve nothing",
            "dataset": "DIR  held-out lightings with their references and errors",
            "port": "N  of the address on this machine (default: a free one)",
            "time": "SECONDS  when, for a model of an animation",
        },
        {"no-open": "open no browser"},
        configured=False,
    ),
    "verify": Verb(verify, "DIR", configured=False),
    "doctor": Verb(doctor, "", configured=False),
}
LATER = {"status"}
