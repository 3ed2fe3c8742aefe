"""Methods of other packages: entry points of the group `ddprt.methods`, see docs/methods.md.

A package that cannot be imported, or that brings what is no method, is left out; it is named in a `Doubt`, and whoever asks for
its method hears why. Names of methods that are there already stay with these.
"""

import re
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import EntryPoint, entry_points

from ddprt.errors import UserError
from ddprt.methods.method import Method
from ddprt.progress import Doubt

GROUP = "ddprt.methods"
ORIGINS: dict[str, str] = {}
"""Names of methods that came from other packages, and of these packages."""

REFUSED: dict[str, str] = {}
"""Names that other packages offered in vain, and why."""

_WORDS = 300  # letters of a message that is not ours

_postponed: list[EntryPoint] = []  # of modules that import this one and are not through yet


def register(methods: dict[str, type[Method]]) -> None:
    """Adds the methods of all installed packages; whoever is just being imported comes with `register_postponed`."""
    _take(methods, tuple(entry_points(group=GROUP)))


def register_postponed(methods: dict[str, type[Method]]) -> None:
    """Adds what could not be added before."""
    waiting, _postponed[:] = _postponed[:], []
    _take(methods, waiting)


def _take(methods: dict[str, type[Method]], points: Sequence[EntryPoint]) -> None:
    for point in points:
        spec = getattr(sys.modules.get(point.module), "__spec__", None)
        if getattr(spec, "_initializing", False):
            _postponed.append(point)
            continue
        package = point.dist.name if point.dist else point.module
        try:
            methods[point.name] = _method(point, methods)
            ORIGINS[point.name] = package
        except UserError as error:
            REFUSED[point.name] = f'method "{point.name}" of package {package}: {error}'
            warnings.warn(f"{REFUSED[point.name]}; it is left out", Doubt, stacklevel=2)


def _method(point: EntryPoint, methods: dict[str, type[Method]]) -> type[Method]:
    """What an entry point leads to.

    Raises:
      UserError: it cannot be imported, is no method, or its name is taken or could not name a folder.
    """
    if not re.fullmatch(r"[A-Za-z0-9][\w-]*", point.name):
        raise UserError(f'got the name "{point.name}", expected letters, digits and hyphens; rename its entry point')
    if point.name in methods:
        raise UserError(f"the name belongs to {ORIGINS.get(point.name, 'ddprt')}; rename its entry point")
    try:
        found = point.load()
    except Exception as error:  # of whatever kind: it is not our code
        words = " ".join(str(error).split())
        raise UserError(f"got {type(error).__name__} on import ({words}); mend or remove the package") from error
    if not (isinstance(found, type) and issubclass(found, Method)):
        raise UserError(f"got {point.value}, expected a class made from ddprt.methods.method.Method; see docs/methods.md")
    missing = [name for name, kind in (("relighter", type), ("why", str)) if not isinstance(getattr(found, name, None), kind)]
    missing += ["fit"] if found.fit is Method.fit else []
    if missing:
        raise UserError(f"got a class without {' and '.join(missing)}, expected all that docs/methods.md asks for; add it")
    return found


@contextmanager
def blamed(name: str) -> Iterator[None]:
    """Whatever goes wrong within, in a method of another package, is told in one line that names both.

    Args:
      name: of the method; errors of those that come with ddprt pass as they are.
    Raises:
      UserError: in place of any other error.
    """
    try:
        yield
    except (UserError, MemoryError):
        raise
    except (Exception, SystemExit) as error:  # of whatever kind: it is not our code
        if name not in ORIGINS:
            raise
        words = " ".join(str(error).split())
        words = f": {words[:_WORDS]}{'...' * (len(words) > _WORDS)}" if words else ""
        raise UserError(
            f'method "{name}" of package {ORIGINS[name]}: got {type(error).__name__}{words}; mend or leave it out'
        ) from error
