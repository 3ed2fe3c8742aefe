"""Clips of glTF files: nodes that move, bodies that bones bend, shapes that blend into others.

A clip is looked at at a time and gives a pose; `gltf.Reader` then reads the file in that pose, so that everything else about it
is read as of a file that stands still. Before its first key and after its last a channel stays as it is there.
"""

import json
import struct
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ddprt.axes import Float64
from ddprt.errors import UserError, nearest
from ddprt.scene.accessors import Container, open_gltf
from ddprt.scene.gltf import Reader
from ddprt.scene.gltf_nodes import transform
from ddprt.scene.mesh import Scene

Motion = Callable[[float], Float64[np.ndarray, "vertices 3"]]
"""Vertices of a scene at a time: seconds in, metres out."""

_WIDTH = {"translation": 3, "rotation": 4, "scale": 3, "weights": 1}
_UNEVEN = 1e-2  # by which weights of a vertex may miss a sum of 1 in a file that rounds them to 8 bits
_STRAIGHT = 1 - 1e-6  # cosine of half the angle from which a turn is interpolated along the chord


@dataclass(frozen=True, eq=False)
class Channel:
    """One property of one node over time.

    Attributes:
      node, path: which.
      times: of its keys, seconds, rising.
      values: at the keys; for cubic splines (keys, 3, numbers): slope before, value, slope after, per second.
      way: "LINEAR", "STEP" or "CUBICSPLINE".
    """

    node: int
    path: str
    times: Float64[np.ndarray, " moments"]
    values: np.ndarray
    way: str

    def at(self, time: float) -> Float64[np.ndarray, " numbers"]:
        """The property at a time; rotations are of length 1."""
        time = float(np.clip(time, self.times[0], self.times[-1]))
        k = int(np.clip(np.searchsorted(self.times, time, side="right") - 1, 0, max(0, len(self.times) - 2)))
        if len(self.times) == 1:
            found = self.values[0, 1] if self.way == "CUBICSPLINE" else self.values[0]
        else:
            span = float(self.times[k + 1] - self.times[k])
            found = self._between(k, (time - float(self.times[k])) / span, span)
        return found / np.linalg.norm(found) if self.path == "rotation" else found

    def _between(self, k: int, t: float, span: float) -> np.ndarray:
        first, last = self.values[k], self.values[k + 1]
        if self.way == "STEP":
            return last if t >= 1 else first
        if self.way == "LINEAR":
            return _turned(first, last, t) if self.path == "rotation" else (1 - t) * first + t * last
        start, end = (2 * t**3 - 3 * t**2 + 1) * first[1], (3 * t**2 - 2 * t**3) * last[1]
        return start + end + span * ((t**3 - 2 * t**2 + t) * first[2] + (t**3 - t**2) * last[0])


@dataclass(frozen=True, eq=False)
class Clip:
    """One animation of a file.

    Attributes:
      file: whose.
      name: its own, or its number.
      channels: what moves.
      resting: weights of morph targets that nodes have by themselves.
      notes: what was mended on the way, in the order it was found.
    """

    file: Container
    name: str
    channels: tuple[Channel, ...]
    resting: dict[int, list[float]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    @property
    def span(self) -> tuple[float, float]:
        """Its first and its last key, seconds."""
        return min(float(entry.times[0]) for entry in self.channels), max(float(entry.times[-1]) for entry in self.channels)

    def at(self, time: float) -> "ClipPose":
        """The pose at a time."""
        return ClipPose(self, {(entry.node, entry.path): entry.at(time) for entry in self.channels})


@dataclass(frozen=True, eq=False)
class ClipPose:
    """How nodes stand at a time; see `ddprt.scene.gltf.Pose`.

    Attributes:
      clip: which.
      values: of what the clip moves, by node and path.
    """

    clip: Clip
    values: dict[tuple[int, str], Float64[np.ndarray, " numbers"]]

    def local(self, number: int) -> Float64[np.ndarray, "4 4"]:
        """Transform of a node to its parent."""
        node = self.clip.file.entry("nodes", number)
        paths = [path for path in ("translation", "rotation", "scale") if (number, path) in self.values]
        moved = {path: self.values[number, path].tolist() for path in paths}
        return transform(_Placed(**{**{key: getattr(node, key) for key in _Placed.__dataclass_fields__}, **moved}))

    def shaped(
        self, number: int, primitive: Any, positions: Float64[np.ndarray, "vertices 3"], world: Float64[np.ndarray, "4 4"]
    ) -> tuple[Float64[np.ndarray, "vertices 3"], Float64[np.ndarray, "4 4"]]:
        """Vertices blended and bent, and what takes them to the world: bones do that themselves, whatever their body's node."""
        if primitive.targets:
            positions = self._blended(number, primitive, positions)
        if self.clip.file.entry("nodes", number).skin is None:
            return positions, world
        return self._bent(number, primitive, positions), np.eye(4)

    def _blended(self, number: int, primitive: Any, positions: np.ndarray) -> np.ndarray:
        """p + sum of w_i d_i."""
        file = self.clip.file
        node = file.entry("nodes", number)
        of_mesh = file.entry("meshes", node.mesh).weights or [0.0] * len(primitive.targets)
        given = self.clip.resting.get(number, of_mesh)
        weights = self.values.get((number, "weights"), np.asarray(given, np.float64))
        if len(weights) != len(primitive.targets):
            raise file.fault(
                f"got {len(weights)} weights for {len(primitive.targets)} morph targets of node {number}, expected one for "
                "each; export it again"
            )
        for weight, target in zip(weights, primitive.targets, strict=True):
            moved = target.get("POSITION") if isinstance(target, dict) else target.POSITION
            if moved is None:
                continue
            offset = file.accessor(moved, 3)
            if len(offset) != len(positions):
                raise file.fault(
                    f"got a morph target of {len(offset)} vertices, expected {len(positions)} as its mesh has; export it again"
                )
            positions = positions + weight * offset
        return positions

    def _bent(self, number: int, primitive: Any, positions: np.ndarray) -> np.ndarray:
        """sum of w_j J_j B_j p: bones' transforms to the world, times what takes the body to each bone."""
        file = self.clip.file
        skin = file.entry("skins", file.entry("nodes", number).skin)
        bones = skin.joints or []
        if not bones:
            raise file.fault(f"got a skin without joints on node {number}, expected at least one; export it again")
        bind = np.tile(np.eye(4), (len(bones), 1, 1))
        if skin.inverseBindMatrices is not None:
            bind = file.accessor(skin.inverseBindMatrices, 16).reshape(-1, 4, 4).swapaxes(1, 2)  # stored by columns
            if len(bind) != len(bones):
                raise file.fault(f"got {len(bind)} bind matrices for {len(bones)} joints, expected as many; export it again")
        reach = np.stack([self._world(bone) for bone in bones]) @ bind
        chosen, weights = self._influences(number, primitive, len(positions), len(bones))
        whole = np.concatenate([positions, np.ones((len(positions), 1))], 1)
        moved = np.zeros_like(positions)
        for k in range(chosen.shape[1]):
            moved += weights[:, k, None] * np.einsum("nij,nj->ni", reach[chosen[:, k], :3], whole)
        return moved

    def _influences(self, number: int, primitive: Any, count: int, bones: int) -> tuple[np.ndarray, np.ndarray]:
        """Joints and weights of each vertex, weights adding up to 1."""
        file = self.clip.file
        sets: list[np.ndarray] = []
        of_sets: list[np.ndarray] = []
        while (joints := getattr(primitive.attributes, f"JOINTS_{len(sets)}", None)) is not None:
            weights = getattr(primitive.attributes, f"WEIGHTS_{len(sets)}", None)
            if weights is None:
                raise file.fault(f"got JOINTS_{len(sets)} without WEIGHTS_{len(sets)}, expected both; export it again")
            sets.append(file.accessor(joints, 4).astype(np.int64))
            of_sets.append(file.accessor(weights, 4))
        if not sets:
            raise file.fault(f"got a skin on node {number} but no JOINTS_0, expected joints of each vertex; export it again")
        chosen, weights = np.concatenate(sets, 1), np.concatenate(of_sets, 1)
        if not len(chosen) == len(weights) == count:
            raise file.fault(f"got joints of {len(chosen)} vertices, expected {count} as the mesh has; export it again")
        if chosen.max(initial=0, where=weights > 0) >= bones:
            raise file.fault(f"got joint {chosen.max()} of {bones} of its skin, expected 0 to {bones - 1}; export it again")
        total = weights.sum(1)
        if not np.isfinite(weights).all() or weights.min(initial=0) < 0 or not (total > 0).all():
            raise file.fault(
                "got a vertex whose joints' weights are negative, not finite or all 0, expected some above 0; paint them again"
            )
        uneven = int(np.count_nonzero(np.abs(total - 1) > _UNEVEN))
        note = f"joints' weights of {uneven} vertices did not add up to 1: scaled so that they do"
        if uneven and note not in self.clip.notes:
            self.clip.notes.append(note)
        return np.where(weights > 0, chosen, 0), weights / total[:, None]

    def _world(self, number: int) -> Float64[np.ndarray, "4 4"]:
        """A node's transform to the world."""
        found, seen = self.local(number), {number}
        while (parent := self._parents.get(number)) is not None:
            if parent in seen:
                raise self.clip.file.fault(f"got node {parent} above itself, expected a tree; export it again")
            found, number = self.local(parent) @ found, parent
            seen.add(parent)
        return found

    @cached_property
    def _parents(self) -> dict[int, int]:
        nodes = enumerate(self.clip.file.json.nodes)
        return {child: number for number, node in nodes for child in node.children or []}


@dataclass(frozen=True)
class _Placed:
    """What `transform` looks at."""

    matrix: Any = None
    translation: Any = None
    rotation: Any = None
    scale: Any = None


def load_clip(path: Path, name: str = "") -> Clip:
    """Reads one animation of a file.

    Args:
      path: a .glb or .gltf.
      name: of the animation, or its number from 0; empty takes the first.
    Raises:
      UserError: there is none of that name, or it is faulty. What else a damaged file leads to is raised as it comes.
    """
    file = open_gltf(path)
    clips = file.json.animations or []
    if not clips:
        raise file.fault("got no animation, expected at least one; export it with its clips, or give poses as files")
    names = [clip.name or str(number) for number, clip in enumerate(clips)]
    number = 0 if not name else names.index(name) if name in names else int(name) if name.isdecimal() else -1
    if not 0 <= number < len(clips):
        raise UserError(f'animation.clip: got "{name}"{nearest(name, names)}; known in {path.name}: {", ".join(names)}')
    channels = [_channel(file, clips[number], entry) for entry in clips[number].channels or []]
    there = tuple(channel for channel in channels if channel is not None)
    if not there:
        raise file.fault(f'got animation "{names[number]}" without a channel that moves a node, expected one; export it again')
    return Clip(file, names[number], there, _resting(path))


def load_moving(path: Path, name: str, at: Callable[[tuple[float, float]], float]) -> tuple[Scene, Motion, Clip]:
    """The scene of a file in one pose of a clip, and its vertices at any time.

    Args:
      path, name: see `load_clip`.
      at: chooses the time of the pose, given the clip's first and last second.
    Raises:
      UserError: see `load_clip` and `gltf.load_gltf`.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # as in `load_gltf`
        clip = load_clip(path, name)
        pose = clip.at(at(clip.span))
        numbers = Reader(clip.file, pose).scene(numbered=True).uv
        assert numbers is not None
        source = numbers[:, 0].astype(np.int64)
        scene = Reader(clip.file, pose, notes=list(clip.notes)).scene()

    def motion(time: float) -> np.ndarray:
        return Reader(clip.file, clip.at(time)).positions()[source]

    return scene, motion, clip


def _resting(path: Path) -> dict[int, list[float]]:
    """Weights of morph targets that nodes of a file have, which pygltflib passes over."""
    data = path.read_bytes()
    text = data[20 : 20 + struct.unpack("<I", data[12:16])[0]] if data[:4] == b"glTF" else data
    return {number: node["weights"] for number, node in enumerate(json.loads(text)["nodes"]) if "weights" in node}


def _channel(file: Container, clip: Any, entry: Any) -> Channel | None:
    """A channel with its keys; None where it names no node, as the standard allows."""
    if entry.target is None or entry.target.node is None:
        return None
    path, node = entry.target.path, file.entry("nodes", entry.target.node)
    if path not in _WIDTH:
        raise file.fault(f'got an animation of "{path}", expected {", ".join(_WIDTH)}; export it without')
    if node.matrix is not None and path != "weights":
        raise file.fault(f"got an animation of node {entry.target.node}, which has a matrix, expected translation, rotation "
                         "and scale; export it again")  # fmt: skip
    samplers = clip.samplers or []
    if entry.sampler is None or not 0 <= entry.sampler < len(samplers):
        raise file.fault(
            f"got sampler {entry.sampler} of {len(samplers)} of an animation, expected one there is; export it again"
        )
    sampler = samplers[entry.sampler]
    way, times = sampler.interpolation or "LINEAR", file.accessor(sampler.input, 1)[:, 0]
    if way not in ("LINEAR", "STEP", "CUBICSPLINE"):
        raise file.fault(f'got interpolation "{way}", expected LINEAR, STEP or CUBICSPLINE; export it again')
    if not len(times) or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        raise file.fault("got keys of an animation whose times do not rise, expected rising seconds; export it again")
    values = file.accessor(sampler.output, _WIDTH[path])
    each = len(times) * (3 if way == "CUBICSPLINE" else 1)
    even = len(values) > 0 and (len(values) % each == 0 if path == "weights" else len(values) == each)
    if not even or not np.isfinite(values).all():
        raise file.fault(
            f"got {len(values)} finite or other values for {len(times)} keys of an animation, expected {each} for each number "
            "that moves; export it again"
        )
    shaped = values.reshape((len(times), 3, -1) if way == "CUBICSPLINE" else (len(times), -1))
    middle = shaped[:, 1] if way == "CUBICSPLINE" else shaped
    if path == "rotation" and not (np.linalg.norm(middle, axis=1) > 0).all():
        raise file.fault("got a rotation of length 0 in an animation, expected unit quaternions; export it again")
    return Channel(entry.target.node, path, times, shaped, way)


def _turned(first: np.ndarray, last: np.ndarray, t: float) -> np.ndarray:
    """Between two rotations, the short way round and at even speed."""
    first, last = first / np.linalg.norm(first), last / np.linalg.norm(last)
    cosine = float(first @ last)
    last, cosine = (-last, -cosine) if cosine < 0 else (last, cosine)
    if cosine > _STRAIGHT:
        return (1 - t) * first + t * last
    angle = np.arccos(cosine)
    return (np.sin((1 - t) * angle) * first + np.sin(t * angle) * last) / np.sin(angle)
