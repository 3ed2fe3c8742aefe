"""Which channels of a picture are its red, green and blue."""

from collections.abc import Iterable
from fnmatch import fnmatchcase

from ddprt.errors import UserError

_TRIPLES = ("RGB", "rgb", "XYZ", "xyz")
USUAL = {
    "direct": ("*diffdir", "*diffuse direct", "*diffuse_direct", "direct*", "*.direct"),
    "indirect": ("*diffind", "*diffuse indirect", "*diffuse_indirect", "indirect*", "*.indirect"),
}
"""Names of layers that are taken for a kind of light where a file has several, in small letters."""

OVER_PI = ("diffdir", "diffind", "diffuse direct", "diffuse indirect")
"""Ends of names of layers that hold E/pi: Blender's diffuse passes, which are without colour."""


def layers(names: Iterable[str]) -> dict[str, tuple[str, ...]]:
    """Channels by layer: three for colours, one for grey; the layer of "R", "G" and "B" is "".

    A grey layer is one channel "Y", "V" or of any name that no triple takes.
    """
    known, found = list(names), dict[str, tuple[str, ...]]()
    for name in known:
        layer, _, last = name.rpartition(".")
        for letters in _TRIPLES:
            prefix = f"{layer}." if layer else ""
            triple = tuple(prefix + letter for letter in letters)
            if last == letters[0] and set(triple) <= set(known):
                found.setdefault(layer, triple)
    taken = {channel for triple in found.values() for channel in triple}
    for name in known:
        layer, _, last = name.rpartition(".")
        if name not in taken and last not in ("A", "a"):
            key = layer if last in ("Y", "V") and layer not in found else name
            found.setdefault("" if key == "Y" else key, (name,))
    return found


def choose(names: Iterable[str], asked: str, kind: str, where: str) -> tuple[str, tuple[str, ...]]:
    """The layer and channels to read.

    Args:
      names: of all channels of the picture.
      asked: a layer, with wildcards or without ("ViewLayer.DiffDir", "*DiffDir"); or one or three channels with commas
        ("S0.R,S0.G,S0.B"); or empty for plain RGB, the only layer, or the one that is usual for this kind.
      kind: "direct", "indirect" or what else is read.
      where: named in messages.
    Raises:
      UserError: no layer fits, or more than one.
    """
    known = list(names)
    there = layers(known)
    if "," in asked:
        parts = tuple(part.strip() for part in asked.split(","))
        missing = [part for part in parts if part not in known]
        if missing or len(parts) != 3:
            got = f"channel {missing[0]}" if missing else f"{len(parts)} channels"
            raise UserError(f'{where}: got {got} in "{asked}", expected three of {_listed(known)}; mend --channels')
        return asked, parts
    if asked:
        fits = [layer for layer in there if fnmatchcase(layer.lower(), asked.lower())]
        if len(fits) != 1:
            got = "no layer" if not fits else f"{len(fits)} layers ({_listed(fits)})"
            raise UserError(f'{where}: got {got} that "{asked}" names, expected one of {_listed(there)}; mend --channels')
        return fits[0], there[fits[0]]
    if len(there.get("", ())) == 3 or len(there) == 1:
        layer = "" if "" in there else next(iter(there))
        return layer, there[layer]
    usual = [layer for layer in there if any(fnmatchcase(layer.lower(), pattern) for pattern in USUAL.get(kind, ()))]
    if len(usual) == 1:
        return usual[0], there[usual[0]]
    if "" in there:
        return "", there[""]
    raise UserError(f"{where}: got layers {_listed(there)}, expected one for {kind} light; say which with --{kind}-channels")


def _listed(names: Iterable[str]) -> str:
    shown = [name or "RGB" for name in names]
    return ", ".join(shown[:8]) + (f" and {len(shown) - 8} more" if len(shown) > 8 else "")
