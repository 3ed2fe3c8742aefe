"""What moves without coming apart: one topology in several poses.

Vertices move, triangles stay what they are. So the lightmap is unwrapped once, on the first pose, and rides on the mesh, as
measurement points do (`ddprt.sampling.riding`). Every pose is a `Scene` like any other, that knows the one it is unwrapped on.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ddprt.axes import Float, Float64
from ddprt.config import Config
from ddprt.errors import UserError
from ddprt.scene.checks import FARTHEST, negligible, vertex_normals
from ddprt.scene.files import EXPECTED, load_scene
from ddprt.scene.gltf_motion import Motion, load_moving
from ddprt.scene.library import SCENES
from ddprt.scene.mesh import Scene
from ddprt.scene.motions import MOTIONS
from ddprt.scene.winding import welded

_TORN = 1e-5  # of the radius: files round positions of one vertex alike


@dataclass(frozen=True, eq=False)
class Animation:
    """A scene in several poses; make one with `ddprt.load_animation`.

    Attributes:
      scene: the first pose, and what all have in common.
      times: of the keyframes, seconds, rising.
      positions: of the vertices at these, metres.
      motion: vertices at any time, as the source tells; of a list of files straight lines between them.
    """

    scene: Scene
    times: Float64[np.ndarray, " keys"]
    positions: Float64[np.ndarray, "keys vertices 3"]
    motion: Motion

    @property
    def keys(self) -> int:
        """How many keyframes."""
        return len(self.times)

    def key(self, index: int) -> Scene:
        """The scene at a keyframe."""
        return posed(self.scene, self.positions[index], f"key {index}")

    def pose(self, time: float) -> Scene:
        """The scene at any time between the first key and the last, as the source has it.

        Raises:
          UserError: a time outside of these, or a pose that is none.
        """
        self.check(time)
        found = np.flatnonzero(self.times == time)
        return self.key(int(found[0])) if len(found) else posed(self.scene, self.motion(time), f"the pose at {time:g} s")

    def check(self, time: float) -> None:
        """Refuses a time outside of the keyframes.

        Raises:
          UserError: it is.
        """
        check_time(self.times, time)

    def between(self, fractions: Sequence[float]) -> list[float]:
        """Times that lie so far on the way from each keyframe to the next."""
        pairs = zip(self.times[:-1].tolist(), self.times[1:].tolist(), strict=True)
        return [first + share * (last - first) for first, last in pairs for share in fractions]


def check_time(times: Float64[np.ndarray, " keys"], time: float) -> None:
    """Refuses a time outside of some keyframes.

    Raises:
      UserError: it is.
    """
    if not times[0] <= time <= times[-1]:
        raise UserError(
            f"time: got {time:g} s, expected {times[0]:g} to {times[-1]:g}, as the keyframes do; choose one within these"
        )


def posed(rest: Scene, positions: Float[np.ndarray, "vertices 3"], name: str) -> Scene:
    """A scene whose vertices have moved; shading normals turn as the faces about their vertex do.

    Args:
      rest: the pose that the lightmap is unwrapped on.
      positions: of its vertices, metres.
      name: of the pose, for messages.
    Raises:
      UserError: another number of vertices, one that is not finite or too far away, or triangles that have lost their area.
    """
    if positions.shape != rest.positions.shape:
        raise UserError(
            f'{name} of "{rest.name}": got {len(positions)} vertices, expected {len(rest.positions)} as the first pose has; '
            "keep the topology"
        )
    if not (np.abs(positions) < FARTHEST).all():
        raise UserError(
            f'{name} of "{rest.name}": got a vertex that is not finite or past {FARTHEST:g} m, expected metres; mend the clip'
        )
    if flat := int(np.count_nonzero(negligible(positions[rest.triangles]))):
        raise UserError(
            f'{name} of "{rest.name}": got {flat} triangles without area that have some in the first pose, expected none; '
            "mend the pose, or take them out of the mesh"
        )
    if np.array_equal(positions, rest.positions):
        return replace(rest, rest=rest)
    before, after = vertex_normals(rest.positions, rest.triangles), vertex_normals(positions, rest.triangles)
    return replace(rest, positions=positions, normals=_turned(rest.normals, before, after), rest=rest)


def load_animation(
    source: str | Path | Sequence[str | Path],
    *,
    keys: int | Sequence[float] = 0,
    clip: str = "",
    **parameters: float | int,
) -> Animation:
    """A moving scene by name, from the clip of a glTF file, or from files that hold a pose each.

    Args:
      source: a key of `MOTIONS`, a path that ends in .glb or .gltf, or a list of mesh files of one topology.
      keys: how many keyframes, evenly over the motion, or their times in seconds; 0 takes 3, or every file of a list.
      clip: name or number of the animation in a glTF file; empty takes the first.
      parameters: numbers that a scene of the library takes.
    Raises:
      UserError: nothing that moves, files of different topology, times that do not rise or lie outside of the motion, poses
        that are none, or what `load_scene` refuses.
    """
    if not isinstance(source, str | Path):
        return _of_files(source, keys, clip)
    path = Path(source)
    if path.suffix.lower() in (".glb", ".gltf"):
        if parameters:
            raise UserError(f"{path.name}: got parameter {next(iter(parameters))}, expected none for a file; leave it out")
        return _of_clip(path, keys, clip)
    if str(source) in SCENES or not path.suffix:
        move = MOTIONS[str(source)]
        if clip:
            raise UserError(f'animation.clip: got "{clip}" for "{source}", expected none; leave it out')
        scene = load_scene(source, fog=None, **parameters)
        times = chosen_times(keys, (0.0, 1.0))
        return _made(scene, times, lambda time: move(scene.positions, time), move(scene.positions, float(times[0])))
    raise UserError(
        f"{path.name}: got one mesh file, expected a .glb or .gltf with a clip; give poses as a list: scene.poses = [...]"
    )


def configured_animation(config: Config) -> Animation:
    """The animation of a configuration.

    Raises:
      UserError: see `load_animation`.
    """
    settings, scene = config.animation, config.scene
    source: str | list[str] = list(scene.poses) if scene.poses else scene.name
    parameters = scene.parameters
    if scene.poses and parameters:
        raise UserError("scene.parameters: got some beside scene.poses, expected none for files; leave them out")
    if scene.fog.given:
        raise UserError("scene.fog: got fog about an animation, expected clear air; leave [scene.fog] or [animation] out")
    return load_animation(source, keys=settings.keys, clip=settings.clip, **parameters)


def chosen_times(keys: int | Sequence[float], span: tuple[float, float]) -> Float64[np.ndarray, " keys"]:
    """Times of keyframes.

    Args:
      keys: how many, 0 for 3; or the times themselves.
      span: first and last second of the motion.
    Raises:
      UserError: times that do not rise or lie outside, or several keys of a motion that takes no time.
    """
    if isinstance(keys, int):
        count = keys or 3
        if count > 1 and span[0] == span[1]:
            raise UserError(f"animation.keys: got {count} of a clip that takes no time, expected 1; set it")
        return np.linspace(span[0], span[1], count) if count > 1 else np.array([span[0]], np.float64)
    times = np.asarray(keys, np.float64)
    if times.ndim != 1 or not len(times) or (np.diff(times) <= 0).any() or times[0] < span[0] or times[-1] > span[1]:
        raise UserError(
            f"animation.keys: got {list(keys)}, expected rising seconds from {span[0]:g} to {span[1]:g}; mend the list"
        )
    return times


def _of_clip(path: Path, keys: int | Sequence[float], clip: str) -> Animation:
    if not path.is_file():
        raise UserError(f"{path}: got no such file, expected a mesh; check the path")
    try:
        first = lambda span: float(chosen_times(keys, span)[0])  # noqa: E731
        scene, motion, found = load_moving(path, clip, first)
        return _made(scene, chosen_times(keys, found.span), motion, scene.positions)
    except UserError:
        raise
    except Exception as problem:
        raise UserError(
            f"{path.name}: got a damaged file, expected {EXPECTED['.gltf']} and a clip; export it again, or run with --debug "
            "to see where reading stopped"
        ) from problem


def _of_files(sources: Sequence[str | Path], keys: int | Sequence[float], clip: str) -> Animation:
    if not len(sources):
        raise UserError("scene.poses: got an empty list, expected mesh files of one topology; name at least one")
    if clip or not (keys == 0 or keys == len(sources)):
        raise UserError(
            f"scene.poses: got {len(sources)} files beside animation.keys = {keys} and clip = {clip!r}, expected a key for "
            "each file; leave both out"
        )
    scenes = [load_scene(source) for source in sources]
    for source, scene in zip(sources, scenes, strict=True):
        same = scene.positions.shape == scenes[0].positions.shape and np.array_equal(scene.triangles, scenes[0].triangles)
        if not same or not _hangs_together(scenes[0], scene):
            raise UserError(
                f"scene.poses: got {len(scene.triangles)} triangles in {source} that are not those of {sources[0]} "
                f"({len(scenes[0].triangles)}), expected one topology; export all poses of one mesh without repairs"
            )
    positions = np.stack([scene.positions for scene in scenes])
    times = np.arange(len(sources), dtype=np.float64)

    def straight(time: float) -> np.ndarray:
        k = int(np.clip(np.floor(time), 0, max(0, len(positions) - 2)))
        return positions[k] if time == k else positions[k] + (time - k) * (positions[k + 1] - positions[k])

    return _made(scenes[0], times, straight, positions[0])


def _hangs_together(first: Scene, other: Scene) -> bool:
    """Whether vertices at one place in the first pose are so in another: files tell corners apart that a mesh shares."""
    _, some, number = np.unique(welded(first.positions), return_index=True, return_inverse=True)
    apart = np.abs(other.positions - other.positions[some[number]]).max()
    return bool(apart <= _TORN * other.radius)


def _made(scene: Scene, times: np.ndarray, motion: Motion, first: np.ndarray) -> Animation:
    """Checked in all its keyframes."""
    if scene.tubes is not None:
        raise UserError(f'"{scene.name}": got strands in an animation, expected triangles alone; hair does not move yet')
    rest = scene if np.array_equal(first, scene.positions) else replace(posed(scene, first, "key 0"), rest=None)
    positions = np.stack([rest.positions, *(motion(float(time)) for time in times[1:])])
    found = Animation(rest, times, positions, motion)
    for index in range(1, len(times)):
        found.key(index)
    return found


def _turned(
    normals: Float64[np.ndarray, "vertices 3"],
    before: Float64[np.ndarray, "vertices 3"],
    after: Float64[np.ndarray, "vertices 3"],
) -> Float64[np.ndarray, "vertices 3"]:
    """Normals turned by what takes `before` to `after` the shortest way; half a turn goes through the opposite."""
    cosine = np.einsum("vd,vd->v", before, after)[:, None]
    axis = np.cross(before, after)
    along = np.einsum("vd,vd->v", axis, normals)[:, None]
    turned = cosine * normals + np.cross(axis, normals) + axis * along / np.maximum(1 + cosine, 1e-9)
    turned = np.where(cosine > -1 + 1e-9, turned, -normals)
    return turned / np.linalg.norm(turned, axis=1, keepdims=True)
