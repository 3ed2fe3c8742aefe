"""Files that are whole or absent: temporary name, fsync, rename; folders that one process at a time writes to."""

import hashlib
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np

from ddprt.errors import UserError

_TEMPORARY = re.compile(r"\..+\.\d+\.tmp(\.\w+)?")  # what `written_whole` writes to
_TRIES = 100  # at a lock that others make and remove meanwhile


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Keeps all others that ask for the same folder out of it while the block runs.

    The lock is a flock on the file `.lock`: it dies with its process, however that ends, and the file goes at the end of the
    block. Temporary files of `written_whole` that a killed process left in the folder, or in a folder in it, are removed. Who
    only reads need not ask. Where there is no flock (Windows, some network file systems), or where nothing can be written,
    nobody is kept out and nothing is removed.

    Raises:
      UserError: another process is there, or the folder cannot be made.
    """
    lock = _locked(folder)
    try:
        if lock is not None:
            for path in (*folder.glob(".*.tmp*"), *folder.glob("*/.*.tmp*")):
                if _TEMPORARY.fullmatch(path.name):
                    with suppress(OSError):  # it only takes room
                        path.unlink()
        yield
    finally:
        if lock is not None:
            with suppress(OSError):
                if _is_at(folder / ".lock", lock):
                    (folder / ".lock").unlink()
            os.close(lock)
            with suppress(OSError):  # nothing was written where the block was left early; any other folder is not empty
                folder.rmdir()


def _locked(folder: Path) -> int | None:
    """The open and locked file `.lock`, or None where there are no locks."""
    try:
        import fcntl
    except ImportError:
        return None
    path = folder / ".lock"
    for _ in range(_TRIES):
        make_folder(folder)
        try:
            lock = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        except FileNotFoundError:  # whoever was here before has just removed the empty folder
            continue
        except OSError as error:
            if not os.access(folder, os.W_OK):
                return None
            raise UserError(
                f"{path}: cannot be opened ({error.strerror or error}); delete it, or choose another folder"
            ) from None
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(lock)
            break
        except OSError:
            os.close(lock)
            return None
        if _is_at(path, lock):
            return lock
        os.close(lock)  # whoever was here before removed it between our opening and our locking
    raise UserError(f"{folder}: another command is working in this folder; wait for it, or give another --out")


def _is_at(path: Path, file: int) -> bool:
    """Whether an open file is the one that a path leads to."""
    try:
        return os.path.samestat(os.fstat(file), path.stat())
    except FileNotFoundError:
        return False


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


def cache_folder() -> Path:
    """Where what only saves time is kept: `DDPRT_CACHE`, else ddprt in the user's cache; it may be deleted at any time."""
    base = os.environ.get("DDPRT_CACHE") or Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ddprt"
    return Path(base)


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


def append_line(path: Path, line: str) -> None:
    """Adds a line to a file and sees it to the disk; what a killed process left of its own line stays a line apart.

    Raises:
      UserError: the file cannot be written.
    """
    try:
        with path.open("a+b") as file:
            end = file.seek(0, os.SEEK_END)
            whole = end == 0
            if end:
                file.seek(end - 1)
                whole = file.read(1) == b"\n"
            file.write((("" if whole else "\n") + line + "\n").encode())
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise UserError(
            f"{path}: cannot be written ({error.strerror or error}); free some space or mend its permissions"
        ) from None


def write_tensors(path: Path, tensors: dict[str, np.ndarray]) -> None:
    """Writes arrays as safetensors, whole."""
    from safetensors.numpy import save

    data = save({name: np.asarray(array, order="C") for name, array in tensors.items()})
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


def sha256(path: Path) -> str:
    """Hash of a file's contents, in hexadecimal.

    Raises:
      UserError: it cannot be read.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror or error}); mend the folder's permissions") from None
