"""Strands of hair or fur: curves with a radius and a colour each, and the files that they come in.

Two formats are read. Our own is text, for what is made by hand or by a script; a line is `radius`, `colour`, `strand` or a
point, and what follows a # is a remark:

    radius 4e-05 1e-05        # of the strands that follow, metres: at the root and at the tip; one number for both
    colour 0.35 0.2 0.1       # of the strands that follow, linear Rec.709, 0 to 1: of much hair seen from afar
    strand
    0 0.1 0
    0 0.11 0.002 3e-05        # a point, metres, from root to tip; a fourth number is its radius

The other is the binary `.hair` of Cem Yuksel (http://www.cemyuksel.com/research/hairmodels/): its lengths bear no unit, so they
are multiplied with a scale; its thickness is taken as a diameter, and a strand's colour as that of its root.
"""

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ddprt.axes import Float32, Float64, Int64
from ddprt.errors import UserError
from ddprt.scene.checks import FARTHEST

SUFFIXES = (".hair", ".strands")
RADIUS, COLOUR = 4e-5, (0.35, 0.2, 0.1)
"""Of strands whose file does not say: metres, those of human hair; and a brown."""

_HEADER = struct.Struct("<4s4I2f3f88s")
_SEGMENTS, _POINTS, _THICKNESS, _TRANSPARENCY, _COLOURS = (1 << bit for bit in range(5))
_SHORTEST = 1e-6  # of its strand's own length: points that are nearer to each other are one


@dataclass(frozen=True, eq=False)
class Strands:
    """Curves of straight pieces, from root to tip.

    Attributes:
      points: of all strands, one after another, metres.
      radius: at each point, metres.
      start: first point of each strand, and the number of points at the end.
      colour: of each strand, linear Rec.709, 0 to 1: what much of it looks like from afar.
    """

    points: Float64[np.ndarray, "points 3"]
    radius: Float64[np.ndarray, " points"]
    start: Int64[np.ndarray, " strands_and_end"]
    colour: Float32[np.ndarray, "strands 3"]

    @property
    def count(self) -> int:
        """How many strands there are."""
        return len(self.start) - 1


def checked_strands(name: str, strands: Strands) -> Strands:
    """The strands, without points that repeat the one before them.

    Raises:
      UserError: no strand, a strand of fewer than two points or without length, or numbers that no strand has.
    """
    if strands.count < 1:
        raise UserError(f"{name}: got no strands, expected at least one; export some")
    for what, values, least in (("a point", strands.points, -FARTHEST), ("a radius", strands.radius, 0.0)):
        rows = values.reshape(len(values), -1)
        wrong = np.flatnonzero(~((rows > least) & (rows < FARTHEST)).all(1))
        if len(wrong):
            strand = int(np.searchsorted(strands.start, wrong[0], side="right")) - 1
            expected = "finite numbers above 0" if least == 0 else f"numbers below {FARTHEST:g}"
            raise UserError(
                f"{name}: got {what} of {rows[wrong[0]].tolist()} m in strand {strand} ({len(wrong)} such), expected "
                f"{expected}; mend the file"
            )
    if not ((strands.colour >= 0) & (strands.colour <= 1)).all():
        raise UserError(f"{name}: got a colour that is not three numbers 0 to 1; mend the file")
    owner = np.repeat(np.arange(strands.count), np.diff(strands.start))
    step = np.linalg.norm(np.diff(strands.points, axis=0), axis=1) * (owner[1:] == owner[:-1])
    length = np.bincount(owner[1:], step, strands.count)
    short = np.flatnonzero((np.diff(strands.start) < 2) | (length == 0))
    if len(short):
        raise UserError(
            f"{name}: got {len(short)} strands without length, the first of index {short[0]}, expected two points or more in "
            "different places; take them out"
        )
    apart = np.append(True, (step > _SHORTEST * length[owner[1:]]) | (owner[1:] != owner[:-1]))
    if apart.all():
        return strands
    start = np.append(0, np.cumsum(np.bincount(owner[apart], minlength=strands.count)))
    return Strands(strands.points[apart], strands.radius[apart], start, strands.colour)


def load_strands(path: Path, scale: float = 1.0) -> Strands:
    """Reads a file of strands; see the top of this file.

    Args:
      path: ends in .hair or .strands.
      scale: metres of a unit of the file.
    Raises:
      UserError: not readable, damaged, cut short, or strands that cannot be.
    """
    if not 0 < scale < FARTHEST:
        raise UserError(f"{path.name}: got scale {scale:g}, expected metres of a unit of the file, above 0; correct it")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: got {error.strerror or error}, expected a file of strands; check the path") from None
    found = _from_hair(path.name, data) if path.suffix.lower() == ".hair" else _from_text(path.name, data)
    with np.errstate(over="ignore"):  # what becomes infinite is refused
        scaled = Strands(found.points * scale, found.radius * scale, found.start, found.colour)
    return checked_strands(path.name, scaled)


def _from_hair(name: str, data: bytes) -> Strands:
    if len(data) < _HEADER.size or data[:4] != b"HAIR":
        raise UserError(
            f'{name}: got {len(data)} bytes that begin with {data[:4]!r}, expected "HAIR" and a header; export again'
        )
    _, strands, points, arrays, segments, thickness, _, *colour, _ = _HEADER.unpack_from(data)
    if not arrays & _POINTS:
        raise UserError(f"{name}: got a file without points, expected some; export it again")
    parts = (
        (_SEGMENTS, "<u2", strands),
        (_POINTS, "<f4", 3 * points),
        (_THICKNESS, "<f4", points),
        (_TRANSPARENCY, "<f4", points),
        (_COLOURS, "<f4", 3 * points),
    )
    expected = _HEADER.size + sum(np.dtype(kind).itemsize * count for bit, kind, count in parts if arrays & bit)
    if len(data) != expected:
        raise UserError(
            f"{name}: got {len(data)} bytes, expected {expected} for {strands} strands of {points} points; the file is damaged"
        )
    read, at = dict[int, np.ndarray](), _HEADER.size
    for bit, kind, count in parts:
        if arrays & bit:
            read[bit] = np.frombuffer(data, kind, count, at)
            at += read[bit].nbytes
    pieces = read[_SEGMENTS].astype(np.int64) if _SEGMENTS in read else np.full(strands, segments, np.int64)
    start = np.append(0, np.cumsum(pieces + 1))
    if start[-1] != points:
        raise UserError(
            f"{name}: got {points} points, but its strands have {start[-1]} together, expected as many; the file is damaged"
        )
    width = read.get(_THICKNESS, np.full(points, thickness, "<f4")).astype(np.float64)
    paint = read.get(_COLOURS, np.tile(np.array(colour, "<f4"), points)).reshape(-1, 3)
    places = read[_POINTS].reshape(-1, 3).astype(np.float64)
    return Strands(places, width / 2, start, paint[np.minimum(start[:-1], points - 1)].astype(np.float32))


def _from_text(name: str, data: bytes) -> Strands:
    points, radii, shares = list[tuple[float, ...]](), list[float](), list[int]()
    starts, colours, ends = list[int](), list[tuple[float, ...]](), list[tuple[float, float]]()
    colour: tuple[float, ...] = COLOUR
    root, tip, line, text = RADIUS, RADIUS, 0, ""
    try:
        for line, text in enumerate(data.decode("utf-8").splitlines(), 1):  # noqa: B007 (told where it stops)
            words = text.partition("#")[0].split()
            if not words:
                continue
            if words[0] == "strand" and len(words) == 1:
                starts.append(len(points))
                colours.append(colour)
                ends.append((root, tip))
            elif words[0] == "radius" and len(words) in (2, 3):
                root, tip = float(words[1]), float(words[-1])
            elif words[0] == "colour":
                red, green, blue = map(float, words[1:])
                colour = red, green, blue
            else:
                x, y, z, *own = map(float, words)
                if not starts or len(own) > 1:
                    raise ValueError
                points.append((x, y, z))
                radii.append(own[0] if own else np.nan)
                shares.append(len(starts) - 1)
    except UnicodeDecodeError:
        raise UserError(f"{name}: got bytes that are no text, expected lines of it; write it again, or name it .hair") from None
    except ValueError:
        raise UserError(
            f'{name}, line {line}: got "{text.strip()[:40]}", expected radius and one or two numbers, colour and '
            "three, strand, or a point of three or four after a strand; mend the file"
        ) from None
    start = np.array([*starts, len(points)], np.int64)
    owner, radius = np.array(shares, np.int64), np.array(radii, np.float64)
    along = (np.arange(len(points)) - start[owner]) / np.maximum(np.diff(start)[owner] - 1, 1) if starts else radius
    given = np.array(ends, np.float64).reshape(-1, 2)[owner]
    unsaid = np.array([one != one for one in radii], bool)
    radius = np.where(unsaid, given[:, 0] + along * (given[:, 1] - given[:, 0]), radius)
    places = np.array(points, np.float64).reshape(-1, 3)
    return Strands(places, radius, start, np.array(colours, np.float32).reshape(-1, 3))
