"""The faces of an OBJ's text as triangles, for a reader that knows no others; the rest of the text stays as it is."""

import re
from pathlib import Path

import numpy as np

from ddprt.errors import UserError
from ddprt.scene.cutting import cut_polygons, notes_on

_FACE = re.compile(rb"^[ \t]*f[ \t]([^#\r\n]*)[^\r\n]*", re.MULTILINE)
_LISTS = tuple(re.compile(rb"^[ \t]*" + name + rb"[ \t]([^#\r\n]*)", re.MULTILINE) for name in (b"v", b"vt", b"vn"))


def with_triangles(path: Path, data: bytes) -> tuple[bytes, list[str]]:
    """The text with polygons cut, and what to note of them.

    Triangles and quads that halve from their first corner are left as they stand. Numbers that count from the end, which means
    from the end of what precedes the face, become plain ones.

    Raises:
      UserError: a face with a vertex that is not there.
    """
    data = re.sub(rb"\\[ \t]*\r?\n", b" ", data)
    faces = [(face, words) for face in _FACE.finditer(data) if len(words := face[1].split()) != 3 or b"-" in face[1]]
    if not faces:
        return data, []
    lines = list(_LISTS[0].finditer(data))
    vertices = np.array([line[1].split()[:3] for line in lines], dtype=np.float64).reshape(-1, 3)
    before = [np.array([entry.start() for entry in lines])]
    before += [np.array([entry.start() for entry in kind.finditer(data)]) for kind in _LISTS[1:]]
    numbered = [_alike([_forward(word, face.start(), before) for word in words]) for face, words in faces]
    index = np.array([int(word.split(b"/")[0]) for words in numbered for word in words], dtype=np.int64)
    if (beyond := index[(index < 1) | (index > len(vertices))]).size:
        expected = f"vertex indices from 1 to {len(vertices)}"
        raise UserError(f"{path.name}: got a face with vertex {beyond[0]}, expected {expected}; export it again")
    sizes, corners = np.array([len(words) for words in numbered]), vertices[index - 1]
    cut = cut_polygons(corners, sizes)
    of_face = np.split(cut.triangles, np.searchsorted(cut.owner, np.arange(1, len(sizes))))
    every, text, done = [word for words in numbered for word in words], [], 0
    for number, (face, _) in enumerate(faces):
        whole = sizes[number] == 3 or (sizes[number] == 4 and cut.fans[number])
        pieces = [numbered[number]] if whole else [[every[corner] for corner in row] for row in of_face[number]]
        text += [data[done : face.start()], b"\n".join(b"f " + b" ".join(piece) for piece in pieces)]
        done = face.end()
    return b"".join([*text, data[done:]]), notes_on(cut, corners, sizes)


def _alike(corners: list[bytes]) -> list[bytes]:
    """The corners of a face, without texture coordinates and normals where only some have them."""
    forms = {tuple(part not in (b"", b"0") for part in corner.split(b"/")) for corner in corners}
    return corners if len(forms) == 1 and all(form[0] for form in forms) else [corner.split(b"/")[0] for corner in corners]


def _forward(word: bytes, place: int, before: list[np.ndarray]) -> bytes:
    """A corner such as -1/-1/-1 in numbers that count from the start of the file."""
    if b"-" not in word:
        return word
    numbers = word.split(b"/")
    for kind, number in enumerate(numbers[:3]):
        if number.startswith(b"-"):
            numbers[kind] = b"%d" % (int(np.searchsorted(before[kind], place)) + 1 + int(number))
    return b"/".join(numbers)
