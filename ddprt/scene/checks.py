"""The one door through which raw arrays become a `Scene`.

What cannot be mended is refused by name; what can be is mended and noted, one line each. Winding is made consistent but
a body is never turned inside out: a room is seen from inside, and only its maker knows.
"""

import numpy as np

from ddprt.axes import Bool, Float, Int
from ddprt.errors import UserError
from ddprt.scene.material import Material
from ddprt.scene.mesh import Scene
from ddprt.scene.winding import repeats, rims, surfaces, welded, winding

UNSAID = 0.8
"""Albedo where a file names none: that of a matt white wall."""

NEGLIGIBLE = 1e-8
"""Triangles lower than this share of the bounding box's diagonal vanish in the tracer's float32."""

FARTHEST = 1e15
"""Metres; beyond it squares of lengths leave float32."""

BRIGHTEST = 1e30
"""W/(m² sr); beyond it sums leave float32."""

DENSEST = 4.0
"""Largest relative index of refraction: that of germanium."""


def checked(
    name: str,
    positions: np.ndarray,
    triangles: np.ndarray,
    *,
    normals: np.ndarray | None = None,
    material: np.ndarray | None = None,
    materials: tuple[Material, ...] = (Material("plain", (UNSAID,) * 3),),
    uv: np.ndarray | None = None,
    colour: np.ndarray | None = None,
    lightmap: np.ndarray | None = None,
    notes: tuple[str, ...] = (),
) -> Scene:
    """Check raw arrays, mend what can be mended and make a `Scene` of them.

    Args:
      name: for messages.
      positions: (vertices, 3), metres, Y up.
      triangles: (triangles, 3) corner indices, counter-clockwise seen from the free space.
      normals: (vertices, 3) of any length; missing, zero or non-finite ones are made from the faces at the vertex.
      material: index into `materials` per triangle; all 0 if left out.
      materials: albedo and texture, each 0 to 1, linear.
      uv: (vertices, 2) texture coordinates, origin top-left; needed where a material has a texture.
      colour: (vertices, 3) linear factors on the albedo, 0 to 1; 1 if left out.
      lightmap: (vertices, 2) places on a lightmap of the file's own, NaN where it has none; judged when a scene is unwrapped.
      notes: what an importer has to say already.
    Returns:
      The scene; `notes` lists the repairs after those given.
    Raises:
      UserError: nothing there, a wrong shape, an index out of range, vertices that are not finite, impossible albedo.
    """
    positions = np.ascontiguousarray(_table(name, "positions", positions, 3), dtype=np.float64)
    triangles = np.array(_table(name, "triangles", triangles, 3))
    if not len(triangles):
        raise UserError(f"{name}: got no triangles, expected at least one; export a triangle mesh")
    _in_range(name, "corner", triangles, len(positions))
    _finite(name, "position", positions, triangles)
    material = np.zeros(len(triangles), np.int32) if material is None else np.asarray(material)
    if material.shape != (len(triangles),):
        raise UserError(
            f"{name}: got materials of shape {material.shape}, expected one index for each of {len(triangles)} triangles"
        )
    _in_range(name, "material", material, len(materials))
    for entry in materials:
        _reflects(name, entry, uv)
    if uv is not None:
        uv = np.asarray(_table(name, "uv", uv, 2, len(positions)), dtype=np.float64)
        _finite(name, "texture coordinate", uv, triangles)
    if colour is not None:
        colour = np.asarray(_table(name, "colour", colour, 3, len(positions)), dtype=np.float64)
        if not ((colour >= 0) & (colour <= 1))[triangles].all():
            raise UserError(f"{name}: got vertex colours that are not 0 to 1, expected linear factors; correct them")
    if lightmap is not None:
        lightmap = np.asarray(_table(name, "lightmap", lightmap, 2, len(positions)), dtype=np.float64)

    found = list(notes)
    triangles = triangles.astype(np.int64)
    weld = welded(positions)
    keep = ~negligible(positions[triangles])
    if removed := np.count_nonzero(~keep):
        found.append(f"{removed} triangles of no area removed")
    repeated, backed = repeats(weld[triangles], keep)
    keep &= ~repeated
    if not keep.any():
        raise UserError(
            f"{name}: got only triangles of no area, expected a surface; check the unit and the scale of the export"
        )
    triangles, material = triangles[keep], material[keep]

    turned, twisted = winding(weld[triangles], _areas(positions[triangles]))
    if repeated.any():
        backed = (np.cumsum(keep) - 1)[backed]
        back = _sheets(positions[triangles[backed]], turned[backed]) if len(backed) else ""
        found.append(f"{np.count_nonzero(repeated)} repeated triangles removed{back}")
    if turned.any():
        found.append(f"{np.count_nonzero(turned)} triangles turned to face as the rest of their surface")
        triangles[turned] = triangles[turned, ::-1]
    if twisted:
        found.append(f"{twisted} surfaces have one side only (like a Moebius strip): winding left as it was")

    _holds_media(name, weld[triangles], positions[triangles], material, materials)
    used, triangles = np.unique(triangles, return_inverse=True)
    triangles = triangles.reshape(-1, 3)
    if dropped := len(positions) - len(used):
        found.append(f"{dropped} vertices of no triangle dropped")
    positions = positions[used]
    uv, colour, lightmap = (None if rows is None else rows[used] for rows in (uv, colour, lightmap))
    given = None if normals is None else np.asarray(_table(name, "normals", normals, 3, len(weld)), dtype=np.float64)[used]
    unit, remark = _shading(positions, triangles, given)
    backs = _open_backs(weld[used][triangles], np.array([entry.two_sided for entry in materials])[material])
    if len(backs):
        first = len(positions)
        own, corner = np.unique(triangles[backs], return_inverse=True)
        positions, unit = np.concatenate([positions, positions[own]]), np.concatenate([unit, -unit[own]])
        uv, colour, lightmap = (None if rows is None else np.concatenate([rows, rows[own]]) for rows in (uv, colour, lightmap))
        triangles = np.concatenate([triangles, first + corner.reshape(-1, 3)[:, ::-1]])
        material = np.concatenate([material, material[backs]])
        remark.append(f"{len(backs)} triangles of two-sided materials have a back of their own")
    return Scene(
        name,
        positions,
        triangles.astype(np.int32),
        unit,
        np.ascontiguousarray(material, dtype=np.int32),
        tuple(materials),
        uv,
        (*found, *remark),
        colour=colour,
        lightmap=lightmap,
    )


def check_materials(scene: Scene) -> None:
    """Makes sure of what `checked` does of materials: those of a scene may have been changed since.

    Raises:
      UserError: impossible values, or a medium that is not shut in.
    """
    for entry in scene.materials:
        _reflects(scene.name, entry, scene.uv)
    if any(entry.subsurface for entry in scene.materials):
        _holds_media(scene.name, welded(scene.positions)[scene.triangles], scene.corners, scene.material, scene.materials)


def vertex_normals(
    positions: Float[np.ndarray, "vertices 3"], triangles: Int[np.ndarray, "triangles 3"]
) -> Float[np.ndarray, "vertices 3"]:
    """Unit normals per vertex: those of the faces there, weighted by their angle at the vertex.

    The angle makes the result independent of how a flat face is cut into triangles. Where the faces cancel out, one of
    their normals is taken. Every vertex must belong to a triangle of some area.
    """
    corners = positions[triangles]
    after, before = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
    cross = np.cross(after[:, 0], before[:, 0])
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    face = cross / length
    angle = np.arctan2(length, np.einsum("tcd,tcd->tc", after, before))
    total = np.stack(
        [np.bincount(triangles.ravel(), (angle * face[:, axis, None]).ravel(), len(positions)) for axis in range(3)], axis=1
    )
    some = np.empty_like(positions)
    some[triangles] = face[:, None]
    size = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(size > 1e-9, total / np.maximum(size, 1e-9), some)


def _open_backs(corners: np.ndarray, two_sided: np.ndarray) -> np.ndarray:
    """Triangles of two-sided materials whose back may be seen: those of surfaces that are not closed.

    Exporters call most closed bodies two-sided too; nobody sees these from inside.
    """
    if not two_sided.any():
        return np.flatnonzero(two_sided)
    surface, is_closed = surfaces(corners)
    return np.flatnonzero(two_sided & ~is_closed[surface])


def _table(name: str, what: str, rows: np.ndarray, columns: int, length: int | None = None) -> np.ndarray:
    rows = np.asarray(rows)
    expected = f"({'n' if length is None else length}, {columns})"
    if rows.ndim != 2 or rows.shape[1] != columns or (length is not None and len(rows) != length):
        raise UserError(f"{name}: got {what} of shape {rows.shape}, expected {expected}; pass one row each")
    return rows


def _in_range(name: str, what: str, index: np.ndarray, count: int) -> None:
    if index.dtype.kind not in "iu":
        raise UserError(f"{name}: got {what} indices of type {index.dtype}, expected integers; convert them")
    outside = (index < 0) | (index >= count)
    if outside.any():
        raise UserError(
            f"{name}: got {what} index {index[outside][0]} ({np.count_nonzero(outside)} out of range),"
            f" expected 0 to {count - 1}; the file is damaged or cut short"
        )


def _finite(name: str, what: str, rows: np.ndarray, triangles: np.ndarray) -> None:
    bad = ~(np.abs(rows) < FARTHEST).all(axis=1)
    at_fault = np.unique(triangles[bad[triangles]])
    if len(at_fault):
        far = np.isfinite(rows[at_fault]).all()
        wrong, expected = ("too large", f"numbers below {FARTHEST:g}") if far else ("not finite", "numbers")
        raise UserError(
            f"{name}: got {len(at_fault)} vertices whose {what} is {wrong}, the first at index {at_fault[0]},"
            f" expected {expected}; {'correct the unit' if far else 'remove them'} and export again"
        )


def _reflects(name: str, material: Material, uv: np.ndarray | None) -> None:
    of = f'of material "{material.name}"'
    albedo = np.asarray(material.albedo, dtype=np.float64)
    if albedo.shape != (3,) or not ((albedo >= 0) & (albedo <= 1)).all():
        raise UserError(f"{name}: got albedo {material.albedo} {of}, expected three numbers 0 to 1; correct it")
    for what, image in material.textures.items():
        channels = {"opacity": (), "gloss": (2,)}.get(what, (3,))
        sound = image.ndim == 2 + len(channels) and image.shape[2:] == channels and image.size
        if not sound or not ((image >= 0) & (image <= 1)).all():
            shape = ", ".join(["height", "width", *map(str, channels)])
            texture = "texture" if what == "albedo" else f"texture of {what}"
            fault = "with values outside of 0 to 1" if sound else f"of shape {image.shape}"
            raise UserError(f"{name}: got a {texture} {of} {fault}, expected ({shape}) with values 0 to 1; correct it")
        if uv is None:
            raise UserError(f"{name}: got a texture {of}, expected texture coordinates too; unwrap it or drop the texture")
    radiance = np.asarray(material.emission.radiance if material.emission else (0, 0, 0), np.float64)
    if radiance.shape != (3,) or not ((radiance >= 0) & (radiance <= BRIGHTEST)).all():
        raise UserError(f"{name}: got radiance {radiance.tolist()} {of}, expected three numbers 0 to {BRIGHTEST:g}; correct it")
    gloss = material.gloss
    if gloss and not all(0 <= value <= 1 for value in (gloss.roughness, gloss.metallic, gloss.dielectric)):
        raise UserError(f"{name}: got {gloss} {of}, expected roughness, metallic and dielectric from 0 to 1; correct it")
    if (medium := material.subsurface) is not None:
        shares, lengths = medium.albedo, medium.mean_free_path
        sound = len(shares) == len(lengths) == 3 and all(0 <= share <= 1 for share in shares)
        sound = sound and all(0 < length < FARTHEST for length in lengths) and -1 < medium.anisotropy < 1
        if not (sound and 1 <= medium.index <= DENSEST):
            raise UserError(
                f"{name}: got {medium} {of}, expected three albedos from 0 to 1, three mean free paths above 0 m, an "
                f"anisotropy between -1 and 1 and an index from 1 to {DENSEST:g}; correct it"
            )
    if material.cutout and not 0 <= material.cutout.cutoff <= 1:
        raise UserError(f"{name}: got cutoff {material.cutout.cutoff:g} {of}, expected 0 to 1; correct it")


def _holds_media(
    name: str, places: np.ndarray, corners: np.ndarray, material: np.ndarray, materials: tuple[Material, ...]
) -> None:
    """Makes sure that a medium is shut in: by closed surfaces of one material each, seen from outside.

    Args:
      name: for messages.
      places, corners: of the triangles, by number (see `welded`) and in metres.
      material, materials: of each triangle, and all.
    Raises:
      UserError: edges without a triangle on each side, which light would leak through; other materials on the same surface; or
        fronts that face inwards.
    """
    filled = np.array([entry.subsurface is not None for entry in materials])[material]
    if not filled.any():
        return
    surface, is_closed = surfaces(places)
    for number in np.unique(surface[filled]):
        own = np.flatnonzero(surface == number)
        entry = materials[material[own[filled[own]][0]]]
        of = f'"{entry.name}", which is filled with a medium,'
        if not is_closed[number]:
            edges, first = rims(places[own])
            x, y, z = corners[own[first // 3], first % 3].round(4).tolist()
            raise UserError(
                f"{name}: got {edges} open edges on a surface of material {of} the first at ({x:g}, {y:g}, {z:g}) m, expected "
                "a closed one, which light does not leak from; close or weld the mesh, or take the medium out of the material"
            )
        if len(others := np.unique(material[own])) > 1:
            found = ", ".join(f'"{materials[index].name}"' for index in others)
            raise UserError(
                f"{name}: got a surface of materials {found} that hangs together, expected {of} to have it alone; part the mesh"
            )
        a, b, c = np.moveaxis(corners[own] - corners[own].mean((0, 1)), 1, 0)
        if np.einsum("td,td->", a, np.cross(b, c)) <= 0:
            raise UserError(
                f"{name}: got a surface of material {of} whose fronts face inwards, expected them to face outwards; flip it"
            )


def _sheets(corners: np.ndarray, turned: np.ndarray) -> str:
    """What became of triangles that lay back to back with others, and which of the two sides is lit now."""
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) * np.where(turned, -1.0, 1.0)[:, None]
    total, area = cross.sum(axis=0), np.linalg.norm(cross, axis=1).sum()
    x, y, z = np.round(total / area, 2) + 0.0
    one_way = np.linalg.norm(total) > 0.99 * area
    side = f"facing ({x:g}, {y:g}, {z:g})" if one_way else "that comes first in the file"
    return f", {len(corners)} of them the back of another: the side {side} is lit; give a sheet thickness if both sides reflect"


def _areas(corners: np.ndarray) -> np.ndarray:
    return 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)


def negligible(corners: Float[np.ndarray, "triangles 3 3"]) -> Bool[np.ndarray, " triangles"]:
    """Triangles too low for the tracer, by the bounding box of all of them."""
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    diagonal = np.linalg.norm(np.ptp(corners.reshape(-1, 3), axis=0))
    return 2 * _areas(corners) <= NEGLIGIBLE * diagonal * longest


def _shading(
    positions: np.ndarray, triangles: np.ndarray, given: np.ndarray | None
) -> tuple[Float[np.ndarray, "vertices 3"], list[str]]:
    made = vertex_normals(positions, triangles)
    if given is None:
        return made, ["shading normals made from the faces"]
    finite = (np.abs(given) < FARTHEST).all(axis=1, keepdims=True)
    length = np.linalg.norm(np.where(finite, given, 0.0), axis=1, keepdims=True)
    good = length > 1e-12
    unit = np.where(good, given / np.where(good, length, 1.0), made)
    behind = np.count_nonzero(np.einsum("vd,vd->v", unit, made) < 0)
    remark = [f"{np.count_nonzero(~good)} missing shading normals made from the faces"] if not good.all() else []
    if behind:
        remark.append(f"{behind} shading normals point behind their faces: left as they are; check the winding")
    return unit, remark
