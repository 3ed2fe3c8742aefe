"""What a cut in the atlas shows, and what stitching makes of it.

Question: how far apart do the two sides of a seam filter, what is left after stitching at which pull, and is the light near
          seams nearer to the truth or farther from it?
Command:  python experiments/seams.py [PICTURE.png] [ATLAS RESOLUTION]
Answer:   the default statue at 128², light in units of its RMS over each map: seams are 0.197 apart on average; a pull of 0.01
          leaves 0.007 (27 times less), and the error within the stitched texels (12 % of all) goes from 0.198 to 0.213. A pull
          of 0.1 leaves 0.019 at an error of 0.204; below 0.01 the error grows faster than the seams close.
"""

import sys
from pathlib import Path

import numpy as np
from scipy.ndimage import map_coordinates

import ddprt
from ddprt import seeds
from ddprt.config import load_config
from ddprt.export.seams import Stitcher, find_seams
from ddprt.report.view import Camera, exposure_for, first_fronts, png, tonemap
from ddprt.scene.atlas import Atlas, build_atlas
from ddprt.scene.gutter import fill_gutter
from ddprt.scene.mesh import Scene
from ddprt.transport.embree import Tracer

PULLS, LIGHTINGS, POINTS, PATHS, PIXELS = (1.0, 0.1, 0.01, 0.001, 0.0001), 4, 2000, 1024, 420


def main(out: str = "seams_before_after.png", resolution: str = "128") -> None:
    changes = {"atlas.resolution": resolution, "lightings.distribution": "around", "points.count": "16"}
    changes |= {"lightings.train": "2", "lightings.validation": "1", "lightings.test": str(LIGHTINGS)}
    changes |= {"transport.samples": "16", "transport.test_samples": "4096"}
    config = load_config(None, changes)
    scene = ddprt.load_scene("statue")
    data, atlas = ddprt.bake(scene, config=config), build_atlas(scene, int(resolution), config.atlas.padding)
    test = data.split("test")
    maps = np.moveaxis(data.maps("indirect", test), 0, 1)
    maps = maps / np.sqrt(np.mean(maps**2, axis=(0, 2), keepdims=True))  # every lighting in units of its own RMS
    raw = fill_gutter(atlas.image(maps.reshape(atlas.count, -1)), data.covered, config.export.gutter)
    known = fill_gutter(data.covered[..., None].astype(np.float32), data.covered, config.export.gutter)[..., 0] > 0
    seams = find_seams(scene.corners, atlas.uv, known)
    band = np.intersect1d(Stitcher(seams).texels, atlas.texel)
    print(f"{seams.edges} edges, {seams.length.sum():.0f} texels long; {len(band)} of {atlas.count} texels take part")

    group = np.sort(seeds.stream(0, "seam points").choice(atlas.slot.ravel()[band], POINTS))
    place, triangle = atlas.sampler.sample(group, seeds.stream(0, "seam places").random((POINTS, 2), np.float32))
    place = place + scene.centre
    scale = np.sqrt(np.mean(data.maps("indirect", test) ** 2, axis=(1, 2)))
    truth = np.concatenate(
        [
            ddprt.irradiance(scene, data.lightings[index], place, scene.geometric_normals[triangle], samples=PATHS)[1] / size
            for index, size in zip(test, scale, strict=True)
        ],
        1,
    )

    def error(image: np.ndarray) -> float:
        return float(np.sqrt(np.mean((filtered(image, uv_at(scene, atlas, place, triangle)) - truth) ** 2)))

    print("all in units of a lighting's RMS\npull     difference across  moved, RMS in the band  error in the band")
    print(f"none     {Stitcher(seams).mismatch(raw).mean():17.4f}  {0:22.4f}  {error(raw):17.4f}")
    for pull in PULLS:
        stitcher = Stitcher(seams, pull)
        closed = stitcher.stitch(raw)
        moved = np.sqrt(np.mean((closed - raw).reshape(-1, raw.shape[2])[band] ** 2))
        print(f"{pull:<7g}  {stitcher.mismatch(closed).mean():17.4f}  {moved:22.4f}  {error(closed):17.4f}")
    Path(out).write_bytes(png(picture(scene, atlas, raw, Stitcher(seams).stitch(raw))))
    print(out)


def picture(scene: Scene, atlas: Atlas, raw: np.ndarray, closed: np.ndarray) -> np.ndarray:
    """The first lighting before and after, seen straight on where texels moved most."""
    tracer = Tracer.of(scene)
    moved = np.abs(closed - raw)[..., :3].sum(2).ravel()[atlas.texel]
    near = np.exp(-(np.linalg.norm(atlas.position[:, None] - atlas.position[None, ::4], axis=2) ** 2) / 0.02)
    centre = 4 * int(np.argmax(moved @ near))
    target, normal = atlas.position[centre], atlas.geometric_normal[centre]
    camera = Camera(tuple((target + 1.1 * normal).tolist()), tuple(target.tolist()), 40.0, 1.0)
    across = (np.arange(PIXELS) + 0.5) / PIXELS
    directions = camera.directions(np.stack(np.meshgrid(across, across), -1).reshape(-1, 2))
    hits = first_fronts(tracer, np.asarray(camera.eye), directions)
    seen = hits.triangle >= 0
    weights = np.stack([1 - hits.u - hits.v, hits.u, hits.v], 1)[seen]
    uv = np.einsum("nc,ncd->nd", weights, atlas.uv[hits.triangle[seen]])
    light = [filtered(image[..., :3], uv) for image in (raw, closed)]
    exposure = exposure_for(light[0])
    panels = np.ones((2, PIXELS * PIXELS, 3))
    for panel, values in zip(panels, light, strict=True):
        panel[seen] = tonemap(values, exposure)
    return np.concatenate(panels.reshape(2, PIXELS, PIXELS, 3), 1)


def uv_at(scene: Scene, atlas: Atlas, place: np.ndarray, triangle: np.ndarray) -> np.ndarray:
    """Lightmap coordinates of points on triangles."""
    a, b, c = np.moveaxis(scene.corners[triangle], 1, 0)
    normal = scene.geometric_normals[triangle] / (2 * scene.areas[triangle, None])
    second = np.einsum("nd,nd->n", np.cross(place - a, c - a), normal)
    third = np.einsum("nd,nd->n", np.cross(b - a, place - a), normal)
    return np.einsum("nc,ncd->nd", np.stack([1 - second - third, second, third], 1), atlas.uv[triangle])


def filtered(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Bilinear lookup as engines do it."""
    height, width, channels = image.shape
    places = [uv[:, 1] * height - 0.5, uv[:, 0] * width - 0.5]
    return np.stack([map_coordinates(image[..., c], places, order=1, mode="nearest") for c in range(channels)], 1)


if __name__ == "__main__":
    main(*sys.argv[1:])
