"""The command line: `ddprt VERB FILE [--option value] [--section.key value]`.

Exit 0 done, 2 the user can mend it (one line), 1 our fault, 130 interrupted and resumable.
"""

import _thread
import os
import shlex
import signal
import sys
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, NoReturn

from ddprt import __version__
from ddprt.call import Call
from ddprt.errors import UserError, nearest
from ddprt.progress import Doubt
from ddprt.verbs import LATER, VERBS

REPORT_ISSUE = "this is our fault: run again with --debug and report what it prints"
_AGAIN = 0.02  # seconds until a dropped interrupt is asked for again
WHOLE = ("seed", "sweep")  # settings that stand in no section
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
        with _doubts_in_one_line(), _no_interrupt_lost():
            code = _dispatch([word for word in typed if word != "--debug"])
        sys.stdout.flush()
    except UserError as error:
        if debug:
            raise
        print(f"ddprt: {error}", file=sys.stderr)
        code = 2
    except KeyboardInterrupt:
        code = _interrupted()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    except Exception as error:
        if debug:
            raise
        if _by_interrupt(error):
            sys.exit(_interrupted())
        print(f"ddprt: {type(error).__name__}: {error} ({REPORT_ISSUE})", file=sys.stderr)
        code = 1
    sys.exit(code)


def _interrupted() -> int:
    print("ddprt: interrupted; finished files are kept, the same command goes on from there", file=sys.stderr)
    return 130


def _by_interrupt(error: BaseException) -> bool:
    """Whether an error arose while an interrupt was on its way out: it may hit a lock between being asked for and held."""
    found: BaseException | None = error
    while found is not None and not isinstance(found, KeyboardInterrupt):
        found = found.__cause__ or found.__context__
    return found is not None


@contextmanager
def _doubts_in_one_line() -> Iterator[None]:
    """Doubts about a result reach stderr even with --quiet, each once, as one line and without a line of code below it."""
    with warnings.catch_warnings():
        as_before, said = warnings.showwarning, set[str]()

        def show(message: Warning | str, category: type[Warning], *where: Any) -> None:
            if issubclass(category, Doubt):
                if str(message) not in said:
                    print(f"warning: {message}", file=sys.stderr, flush=True)
                said.add(str(message))
            else:
                as_before(message, category, *where)

        warnings.simplefilter("always", Doubt)
        warnings.showwarning = show  # type: ignore[assignment]
        yield


@contextmanager
def _no_interrupt_lost() -> Iterator[None]:
    """Python drops an interrupt that hits a destructor or a callback of its garbage collector: it is asked for again.

    JAX has such a callback, which runs often enough to be hit: two of four interrupts of a small sweep were lost in it.
    """
    as_before = sys.unraisablehook

    def again(dropped: Any) -> None:
        if not isinstance(dropped.exc_value, KeyboardInterrupt):
            as_before(dropped)
            return
        later = threading.Timer(_AGAIN, _interrupt)  # now, it would be dropped with this hook
        later.daemon = True
        later.start()

    sys.unraisablehook = again
    try:
        yield
    finally:
        sys.unraisablehook = as_before


def _interrupt() -> None:
    """As Ctrl-C does: a signal wakes a main thread that waits for others."""
    main_thread = threading.main_thread().ident
    if main_thread is not None and hasattr(signal, "pthread_kill"):  # not on Windows
        signal.pthread_kill(main_thread, signal.SIGINT)
    else:
        _thread.interrupt_main()


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
        known = key in verb.options or (verb.configured and ("." in key or key in WHOLE))
        if known and "." in key:
            from ddprt.config import check_key

            check_key(key, name)
        if not known:
            choices = [*verb.options, *verb.flags, *FLAGS]
            if verb.configured:
                from ddprt.config import keys

                choices += keys()
            hint = nearest(key, choices) or ";"
            raise UserError(f"--{key}: unknown option{hint} `ddprt {name} --help` lists all")
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
        print("  --sweep '{fit.bases = [4, 8]}'           the same of several settings at once")
        print("  --budget.scenario.KEY VALUE              a setting of [lightings] that held-out ones differ in")
        tyro.cli(Config, args=["--help"], prog=usage, add_help=True, config=(tyro.conf.FlagConversionOff,))
