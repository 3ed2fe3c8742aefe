"""The command line: `ddprt VERB FILE [--option value] [--section.key value]`.

Exit 0 done, 2 the user can mend it (one line), 1 our fault, 130 interrupted and resumable. Imports stay inside the verbs,
so that help is instant.
"""

import os
import shlex
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

from ddprt import __version__
from ddprt.errors import UserError, nearest
from ddprt.progress import Doubt

REPORT_ISSUE = "this is our fault: run again with --debug and report what it prints"


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
    data = job.dataset()
    models, seconds = job.fit(data)
    evaluation = job.evaluate(data, models, seconds)
    budget = job.budget(data, models) if call.asks("budget") else None
    report = job.report(data, models, evaluation, budget=budget)
    if budget is not None:
        from ddprt.bench.budget import table

        print(f"{table(budget)}\nbudget:   {job.folder / 'budget.json'}")
    print(f"metrics:  {job.folder / 'metrics.json'}\nreport:   {report}")


def bench(call: Call) -> None:
    """try settings about a configuration: error against seconds, bytes and memory"""
    if call.asks("peers"):
        return peers(call)
    if call.asks("quick"):
        raise UserError("--quick: got no --peers, which it belongs to; a sweep is shortened by --sweep.SECTION.KEY")
    results, page, *others = call.run().sweep()
    print(f"results:  {results}\npage:     {page}\nfigures:  {others[-1].parent}")
    return None


def peers(call: Call) -> None:
    """Our fit, transfer and relighting beside everyone else's."""
    from ddprt.bench.peers import peers, table
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
    from ddprt.bench.tune import told

    call.overrides |= {f"tune.{key.replace('-', '_')}": call.options[key] for key in _LIMITS if key in call.options}
    job = call.run()
    outcome = job.tune()
    print(told(outcome))
    if not outcome.met:
        raise UserError(
            f"ddprt tune: got a budget that no setting meets, {outcome.binding} stands in the way; "
            f"raise --max-{outcome.binding.replace('_', '-')}, or take {job.folder / 'tune' / 'nearest.toml'}"
        )
    print(f"config:   {job.folder / 'tune' / 'tuned.toml'}")


def relight(call: Call) -> None:
    """turn a lighting into an indirect lightmap: ddprt relight MODEL --lighting lights.json --out relit.exr"""
    import json

    from ddprt.lights import load_lightings, parse_lighting
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
    else:
        lightings = load_lightings(source)
    for index, lighting in enumerate(lightings):
        path = out if len(lightings) == 1 else out.with_stem(f"{out.stem}_{index:03d}")
        measured = model.measure(lighting)
        image, trust = model.image(model.predict(measured)), model.trust(measured)
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
    """write basis textures, matrices and a manifest for engines"""
    from ddprt.runtime.model_file import load_model

    job = call.run()
    job.export(load_model(job.folder / "model.ddprt"))
    print(f"textures: {job.folder / 'export'}")


def verify(call: Call) -> None:
    """find damaged or missing files of a dataset"""
    from ddprt.dataset.store import Manifest, expected_files, read_description

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
        options=_OUT,
        flags={
            "peers": "compare fit, transfer and relighting with other libraries; FILE may be left out",
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
    "verify": Verb(verify, "DIR", configured=False),
    "doctor": Verb(doctor, "", configured=False),
}
LATER = {"import", "view", "status"}
FLAGS = {"quiet": "no progress", "debug": "tracebacks instead of one-line errors"}


def usage() -> str:
    """The text of `ddprt --help`."""
    rows = "\n".join(f"  {name:<9}{verb.work.__doc__}" for name, verb in VERBS.items())
    return (
        f"ddprt {__version__}: learn how a scene answers to light, relight it without tracing a ray.\n\n"
        f"usage: ddprt VERB FILE [--option value] [--section.key value]\n\n{rows}\n\n"
        "`ddprt VERB --help` lists the options and every setting. Start with: ddprt run configs/cornell.toml\n"
    )


def main(arguments: list[str] | None = None) -> NoReturn:
    """Entry point of the `ddprt` command."""
    typed = sys.argv[1:] if arguments is None else arguments
    debug = "--debug" in typed
    try:
        with _doubts_in_one_line():
            code = _dispatch([word for word in typed if word != "--debug"])
        sys.stdout.flush()
    except UserError as error:
        if debug:
            raise
        print(f"ddprt: {error}", file=sys.stderr)
        code = 2
    except KeyboardInterrupt:
        print("ddprt: interrupted; finished files are kept, the same command goes on from there", file=sys.stderr)
        code = 130
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    except Exception as error:
        if debug:
            raise
        print(f"ddprt: {type(error).__name__}: {error} ({REPORT_ISSUE})", file=sys.stderr)
        code = 1
    sys.exit(code)


@contextmanager
def _doubts_in_one_line() -> Iterator[None]:
    """Doubts about a result reach stderr even with --quiet, each as one line and without a line of code below it."""
    with warnings.catch_warnings():
        as_before = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *where: Any) -> None:
            if issubclass(category, Doubt):
                print(f"warning: {message}", file=sys.stderr, flush=True)
            else:
                as_before(message, category, *where)

        warnings.simplefilter("always", Doubt)
        warnings.showwarning = show  # type: ignore[assignment]
        yield


def _dispatch(words: list[str]) -> int:
    if not words or words[0] in ("-h", "--help", "help"):
        print(usage(), end="")
        return 0 if words else 2
    if words[0] in ("-V", "--version"):
        print(__version__)
        return 0
    name, rest = words[0], words[1:]
    if name in LATER:
        raise UserError(f"ddprt {name}: not built yet; known: {', '.join(VERBS)}")
    if name not in VERBS:
        raise UserError(f'no verb "{name}"{nearest(name, VERBS)}; known: {", ".join(VERBS)}')
    if "-h" in rest or "--help" in rest:
        _help(name)
        return 0
    call = parse(name, rest)
    _keep_compiled()
    VERBS[name].work(call)
    return 0


def _keep_compiled() -> None:
    """Lets JAX keep what it compiles for the next command, unless it is told elsewhere where to."""
    if "jax" in sys.modules:  # it reads these when it is imported; within another program they are not ours to set
        return
    from ddprt.files import cache_folder
    from ddprt.machine import instruction_set

    folder = cache_folder() / f"jax-{instruction_set()}"
    with suppress(OSError):  # a cache that cannot be written only costs time
        folder.mkdir(parents=True, exist_ok=True)
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(folder))
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")


def parse(name: str, words: list[str]) -> Call:
    """Words after a verb as files, options and overrides.

    Raises:
      UserError: unknown option, or one without a value.
    """
    verb = VERBS[name]
    call = Call(name, command=shlex.join(["ddprt", name, *words]))
    queue = list(words)
    while queue:
        word = queue.pop(0)
        if not word.startswith("--"):
            call.files.append(word)
            continue
        key, given, value = word[2:].partition("=")
        if key in {**verb.flags, **FLAGS} and not given:
            call.options[key] = ""
            continue
        known = key in verb.options or (verb.configured and ("." in key or key == "seed"))
        if known and "." in key:
            from ddprt.config import check_key

            check_key(key, name)
        if not known:
            choices = [*verb.options, *verb.flags, *FLAGS]
            if verb.configured:
                from ddprt.config import keys

                choices += keys()
            raise UserError(f"--{key}: unknown option{nearest(key, choices)}; `ddprt {name} --help` lists all")
        if not given:
            if not queue:
                raise UserError(f"--{key}: got no value, expected one after it; write --{key} VALUE")
            value = queue.pop(0)
        if not value and key in verb.options:
            raise UserError(
                f"--{key}: got an empty value, expected {verb.options[key].split('  ')[0]}; give one or leave it out"
            )
        (call.options if key in verb.options else call.overrides)[key] = value
    return call


def _help(name: str) -> None:
    verb = VERBS[name]
    rows = [f"  --{key} {text}" for key, text in {**verb.options, **verb.flags, **FLAGS}.items()]
    usage = f"ddprt {name} {verb.file}".rstrip()
    print(f"{usage}: {verb.work.__doc__}\n\noptions:\n" + "\n".join(rows))
    if verb.configured:
        import tyro

        from ddprt.config import Config

        print("\nsettings (in the file as [section] key = value, here as --section.key value):")
        print("  --methods.settings.NAME '{key = value}'  settings of one method")
        print("  --sweep.SECTION.KEY '[value, value]'     what `ddprt bench` tries of a setting")
        print("  --budget.scenario.KEY VALUE              a setting of [lightings] that held-out ones differ in")
        tyro.cli(Config, args=["--help"], prog=usage, add_help=True, config=(tyro.conf.FlagConversionOff,))
