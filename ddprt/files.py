"""Files that are whole or absent: temporary name, fsync, rename."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np

from ddprt.errors import UserError


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Gives a temporary path beside `path` to write to, and moves it into place when the block ends well.

    Raises:
      UserError: the folder cannot be written or the disk is full; what was at `path` before is untouched.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp{path.suffix}")
    try:
        make_folder(path.parent)
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        raise UserError(
            f"{path}: cannot be written ({error.strerror or error}); free some space or choose another folder"
        ) from None
    finally:
        with suppress(OSError):  # below a regular file there is nothing to remove, and that is an error too
            temporary.unlink()


def make_folder(path: Path) -> None:
    """Creates a folder and its parents.

    Raises:
      UserError: it cannot be.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{path}: folder cannot be made ({error.strerror or error}); choose another with --out") from None


def write_text(path: Path, text: str) -> None:
    """Writes UTF-8 text whole."""
    with written_whole(path) as temporary:
        temporary.write_text(text, "utf-8")


def write_tensors(path: Path, tensors: dict[str, np.ndarray]) -> None:
    """Writes arrays as safetensors, whole."""
    from safetensors.numpy import save

    data = save({name: np.ascontiguousarray(array) for name, array in tensors.items()})
    with written_whole(path) as temporary:
        temporary.write_bytes(data)


def read_tensors(path: Path) -> dict[str, np.ndarray]:
    """Reads safetensors.

    Raises:
      UserError: missing or damaged.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    try:
        return load_file(path)
    except (OSError, SafetensorError) as error:
        raise UserError(f"{path}: not a whole tensor file ({error}); make it again") from None
