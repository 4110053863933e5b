"""What a vehicle shows of files: a small tree of mounts, each of them closed in itself.

`Folder` is a real folder, read-only or a sandbox with a quota; `MemoryFiles` are read-only files that exist nowhere
else; `Mounts` puts them together. All of them speak in paths that `parse_path` has made, and say what went wrong with
an `OSError` that has an errno.

Nothing of a `Folder` is found by a path of the operating system: every step is opened in the directory before it, and
no symbolic link is followed, so neither a name nor a race leads out of the root.
"""

from __future__ import annotations

import errno
import os
import stat
from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from itertools import count, islice
from pathlib import Path
from typing import NamedTuple, NoReturn, Protocol, TypeAlias

from mavsitl.keep import Work

__all__ = [
    "MAX_ENTRIES",
    "Entry",
    "FilePath",
    "FileTree",
    "Folder",
    "Gaps",
    "MemoryFiles",
    "Mounts",
    "Quota",
    "Reader",
    "Writer",
    "parse_path",
]

FilePath: TypeAlias = tuple[str, ...]
"""Names from the root down; the root is `()`. None of them is empty, "." or "..", all of them are printable ASCII."""

MAX_ENTRIES = 1024
"""Of one directory no more than this is shown, which bounds what a listing costs."""

_MAX_NAME_BYTES = 255
_UNFINISHED = ".mavsitl-upload-"
"""Names that begin so are files on their way in; nobody else sees or makes them."""

_DIRECTORY_FLAGS = os.O_RDONLY | getattr(os, "O_DIRECTORY", 0) | getattr(os, "O_CLOEXEC", 0)
_NO_FOLLOW = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0)
_NO_WAIT = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0)


def _fail(code: int) -> NoReturn:
    raise OSError(code, os.strerror(code))


def parse_path(raw: bytes) -> FilePath:
    """The path in `raw`, which ends at the first NUL; with or without a leading slash it begins at the root.

    Raises `OSError`: EACCES for "..", whatever it would lead to; ENAMETOOLONG; ENOENT for names that are not printable
    ASCII: a tab or a line end would break the listings of clients, and more than one byte per character does
    QGroundControl's.
    """
    names = []
    for name in raw.split(b"\0", 1)[0].split(b"/"):
        if name in (b"", b"."):
            continue
        if name == b"..":
            _fail(errno.EACCES)
        if len(name) > _MAX_NAME_BYTES:
            _fail(errno.ENAMETOOLONG)
        if not _servable(name):
            _fail(errno.ENOENT)
        names.append(name.decode("ascii"))
    return tuple(names)


def _servable(name: bytes) -> bool:
    return all(0x20 <= byte < 0x7F for byte in name)


class Entry(NamedTuple):
    """One file or directory of a listing."""

    name: str
    is_directory: bool
    size_bytes: int
    modified_s: float
    """Unix time; 0 where there is none."""


class Reader(Protocol):
    """An open file. What is appended later is not part of it: `size_bytes` stays as it was when it was opened."""

    @property
    def size_bytes(self) -> int: ...

    def read(self, offset: int, length: int) -> bytes:
        """Up to `length` bytes; fewer at the end, none behind it."""

    def close(self) -> None: ...


class Writer(Protocol):
    """A file on its way in: nobody sees it until `commit`, and whatever it replaces stays until then."""

    @property
    def size_bytes(self) -> int: ...

    def write(self, offset: int, data: bytes) -> None:
        """Raises `OSError` ENOSPC where the quota ends; nothing is written then."""

    def commit(self) -> None:
        """Put it in its place, whole. It is closed afterwards, even where that fails."""

    def abandon(self) -> None:
        """Forget it."""


class FileTree(Protocol):
    """What the file services ask of what is behind them. Everything raises `OSError` with an errno."""

    @property
    def writable(self) -> bool: ...

    def entries(self, path: FilePath) -> list[Entry]:
        """What is in a directory, in the order of the names."""

    def open_read(self, path: FilePath) -> Reader: ...

    def open_write(self, path: FilePath, *, truncate: bool) -> Writer:
        """A new file, or a new version of one: from nothing with `truncate`, else from what it contains."""

    def remove(self, path: FilePath) -> None: ...

    def rename(self, old: FilePath, new: FilePath) -> None: ...

    def make_directory(self, path: FilePath) -> None: ...

    def remove_directory(self, path: FilePath) -> None: ...

    def truncate(self, path: FilePath, size_bytes: int) -> None: ...


class Gaps:
    """Which bytes of a file are still missing; what a download goes by."""

    def __init__(self, size_bytes: int) -> None:
        self._gaps: list[tuple[int, int]] = [(0, size_bytes)] if size_bytes else []

    def __len__(self) -> int:
        return len(self._gaps)

    def __iter__(self) -> Iterator[tuple[int, int]]:
        """(first byte, byte behind the last one), in order."""
        return iter(self._gaps)

    @property
    def missing_bytes(self) -> int:
        return sum(end - begin for begin, end in self._gaps)

    def fill(self, begin: int, end: int) -> bool:
        """These bytes have come; whether any of them was missing."""
        if end <= begin:
            return False
        first = max(0, bisect_right(self._gaps, (begin, begin)) - 1)
        last, rest = first, []
        hit = False
        while last < len(self._gaps) and self._gaps[last][0] < end:
            low, high = self._gaps[last]
            if high <= begin:
                rest.append((low, high))
            else:
                hit = True
                rest += [piece for piece in ((low, min(high, begin)), (max(low, end), high)) if piece[0] < piece[1]]
            last += 1
        self._gaps[first:last] = rest
        return hit


# ------------------------------------------------------------------------------------------------------ read-only


class _ReadOnly:
    """The refusals of a tree that nobody writes to."""

    @property
    def writable(self) -> bool:
        return False

    def open_write(self, path: FilePath, *, truncate: bool) -> Writer:
        _fail(errno.EROFS)

    def remove(self, path: FilePath) -> None:
        _fail(errno.EROFS)

    def rename(self, old: FilePath, new: FilePath) -> None:
        _fail(errno.EROFS)

    def make_directory(self, path: FilePath) -> None:
        _fail(errno.EROFS)

    def remove_directory(self, path: FilePath) -> None:
        _fail(errno.EROFS)

    def truncate(self, path: FilePath, size_bytes: int) -> None:
        _fail(errno.EROFS)


class _BytesReader:
    def __init__(self, content: bytes) -> None:
        self._content = content

    @property
    def size_bytes(self) -> int:
        return len(self._content)

    def read(self, offset: int, length: int) -> bytes:
        return self._content[offset : offset + length]

    def close(self) -> None:
        pass


class MemoryFiles(_ReadOnly):
    """Read-only files that are bytes, or a function that makes them whenever the file is opened or listed."""

    def __init__(self, files: Mapping[str, bytes | Callable[[], bytes]]) -> None:
        """`files` by their path, e.g. ``{"param.pck": make_pack}``."""
        self._files = {parse_path(name.encode()): content for name, content in files.items()}

    def _content(self, path: FilePath) -> bytes:
        content = self._files[path]
        return content if isinstance(content, bytes) else content()

    def entries(self, path: FilePath) -> list[Entry]:
        depth = len(path)
        found: dict[str, Entry] = {}
        for name in self._files:
            if name[:depth] == path and len(name) > depth:
                leaf = len(name) == depth + 1
                size_bytes = len(self._content(name)) if leaf else 0
                found[name[depth]] = Entry(name[depth], not leaf, size_bytes, 0.0)
        if not found and path:
            _fail(errno.ENOTDIR if path in self._files else errno.ENOENT)
        return [found[name] for name in sorted(found)][:MAX_ENTRIES]

    def open_read(self, path: FilePath) -> Reader:
        if path not in self._files:
            _fail(errno.EISDIR if any(name[: len(path)] == path for name in self._files) else errno.ENOENT)
        return _BytesReader(self._content(path))


# --------------------------------------------------------------------------------------------------- a real folder


class Quota(NamedTuple):
    """How much may be in a sandbox at once."""

    size_bytes: int = 16 * 1024 * 1024
    files: int = 128
    """Directories count, too."""


class _FileReader:
    def __init__(self, handle: int, size_bytes: int) -> None:
        self._handle = handle
        self._size_bytes = size_bytes

    @property
    def size_bytes(self) -> int:
        return self._size_bytes

    def read(self, offset: int, length: int) -> bytes:
        return os.pread(self._handle, max(0, min(length, self._size_bytes - offset)), offset)

    def close(self) -> None:
        if self._handle >= 0:
            handle, self._handle = self._handle, -1
            os.close(handle)


class _FolderWriter:
    def __init__(
        self, folder: Folder, directory: int, handle: int, unfinished: str, name: str, size_bytes: int
    ) -> None:
        self._folder = folder
        self._directory = directory
        self._handle = handle
        self._unfinished = unfinished
        self._name = name
        self._size_bytes = size_bytes

    @property
    def size_bytes(self) -> int:
        return self._size_bytes

    def write(self, offset: int, data: bytes) -> None:
        end = offset + len(data)
        self._folder.reserve(max(0, end - self._size_bytes))
        view = memoryview(data)
        while view:
            written = os.pwrite(self._handle, view, offset)
            view, offset = view[written:], offset + written
        self._size_bytes = max(self._size_bytes, end)

    def commit(self) -> None:
        if self._handle < 0:
            return
        try:
            os.replace(self._unfinished, self._name, src_dir_fd=self._directory, dst_dir_fd=self._directory)
        except OSError:
            self.abandon()
            raise
        self._folder.settle(self._handle, self._directory)
        self._forget()

    def abandon(self) -> None:
        if self._handle < 0:
            return
        with suppress(OSError):
            os.unlink(self._unfinished, dir_fd=self._directory)
        os.close(self._handle)
        os.close(self._directory)
        self._forget()

    def _forget(self) -> None:
        self._handle = self._directory = -1
        self._folder.measure()


class _Settlement:
    """A file in its place whose bytes may still be in the system's memory: closed once they are on the disk."""

    def __init__(self, handle: int, directory: int) -> None:
        self._handles = (handle, directory)

    def write(self) -> None:
        """Raises `OSError`."""
        try:
            for handle in self._handles:
                os.fsync(handle)
        finally:
            for handle in self._handles:
                os.close(handle)


MAX_UNSETTLED = 16
"""Files that may wait to be settled, with two handles each."""


class Folder:
    """A real folder. Only plain files and directories in it exist for the outside; links and devices do not.

    With a `Quota` it is a sandbox that can be written to, else it is read-only. A sandbox belongs to one process at a
    time: uploads that an earlier one left unfinished are removed.
    """

    def __init__(
        self, root: str | os.PathLike[str], quota: Quota | None = None, *, settles_later: bool = False
    ) -> None:
        """`root` itself need not exist yet; for a sandbox it is made. Needs an operating system with openat (POSIX).

        `settles_later`: to wait until a new file is on the disk takes some milliseconds, for which a control loop that
        answers clients has no time; somebody else asks for what is `unsettled`.
        """
        if os.open not in os.supports_dir_fd:  # pragma: no cover
            raise NotImplementedError("no directory handles on this system: a folder cannot be served safely")
        self._root = Path(root)
        self._quota = quota
        self._used_bytes = 0
        self._used_files = 0
        self._unfinished = count()
        self._settles_later = settles_later
        self._unsettled: list[_Settlement] = []
        if quota is not None:
            self._root.mkdir(parents=True, exist_ok=True)
            self.measure(tidy=True)

    @property
    def writable(self) -> bool:
        return self._quota is not None

    @property
    def used(self) -> Quota:
        """What a sandbox contains by now."""
        return Quota(self._used_bytes, self._used_files)

    # -- the disk

    def settle(self, handle: int, directory: int) -> None:
        """A new file has taken its place: see to it that it outlives the system, too. Takes the handles."""
        settlement = _Settlement(handle, directory)
        if self._settles_later and len(self._unsettled) < MAX_UNSETTLED:
            self._unsettled.append(settlement)
        else:
            with suppress(OSError):
                settlement.write()

    def unsettled(self) -> list[Work]:
        """What is to be done for files that are in their place, safe from a kill, and not from a crash of the system.

        It is handed out once.
        """
        waiting, self._unsettled = self._unsettled, []
        return [*waiting]

    # -- reading

    def entries(self, path: FilePath) -> list[Entry]:
        found = []
        with self._directory(path) as directory, os.scandir(directory) as scan:
            for item in islice(scan, MAX_ENTRIES):
                if not _servable(os.fsencode(item.name)) or item.name.startswith(_UNFINISHED):
                    continue
                try:
                    status = item.stat(follow_symlinks=False)
                except OSError:
                    continue  # it has gone since
                if stat.S_ISDIR(status.st_mode):
                    found.append(Entry(item.name, True, 0, status.st_mtime))
                elif stat.S_ISREG(status.st_mode):
                    found.append(Entry(item.name, False, status.st_size, status.st_mtime))
        return sorted(found)

    def open_read(self, path: FilePath) -> Reader:
        with self._parent(path) as (directory, name):
            self._status(directory, name)
            handle = os.open(name, os.O_RDONLY | _NO_FOLLOW | _NO_WAIT, dir_fd=directory)
        status = os.fstat(handle)
        if not stat.S_ISREG(status.st_mode):
            os.close(handle)
            _fail(errno.EACCES)
        return _FileReader(handle, status.st_size)

    # -- writing

    def open_write(self, path: FilePath, *, truncate: bool) -> Writer:
        self._must_be_writable()
        with self._parent(path) as (directory, name):
            old_bytes = self._size(directory, name)
            self.measure()
            self._reserve_file()
            kept = b""
            if old_bytes and not truncate:
                self.reserve(old_bytes)
                old = self.open_read(path)
                try:
                    kept = old.read(0, old_bytes)
                finally:
                    old.close()
            own = os.dup(directory)
            unfinished = f"{_UNFINISHED}{next(self._unfinished)}"
            try:
                handle = os.open(unfinished, os.O_RDWR | os.O_CREAT | os.O_EXCL | _NO_FOLLOW, 0o644, dir_fd=own)
            except OSError:
                os.close(own)
                raise
        writer = _FolderWriter(self, own, handle, unfinished, name, 0)
        try:
            self._used_bytes -= len(kept)
            writer.write(0, kept)
        except OSError:
            writer.abandon()
            raise
        return writer

    def remove(self, path: FilePath) -> None:
        self._must_be_writable()
        with self._parent(path) as (directory, name):
            self._status(directory, name)
            os.unlink(name, dir_fd=directory)
        self.measure()

    def rename(self, old: FilePath, new: FilePath) -> None:
        self._must_be_writable()
        with self._parent(old) as (from_directory, old_name), self._parent(new) as (to_directory, new_name):
            self._status(from_directory, old_name, directories=True)
            with suppress(FileNotFoundError):
                self._status(to_directory, new_name, directories=True)
            os.rename(old_name, new_name, src_dir_fd=from_directory, dst_dir_fd=to_directory)
        self.measure()

    def make_directory(self, path: FilePath) -> None:
        self._must_be_writable()
        with self._parent(path) as (directory, name):
            self.measure()
            self._reserve_file()
            os.mkdir(name, 0o755, dir_fd=directory)
        self.measure()

    def remove_directory(self, path: FilePath) -> None:
        self._must_be_writable()
        with self._parent(path) as (directory, name):
            os.rmdir(name, dir_fd=directory)
        self.measure()

    def truncate(self, path: FilePath, size_bytes: int) -> None:
        self._must_be_writable()
        with self._parent(path) as (directory, name):
            old_bytes = self._status(directory, name).st_size
            self.measure()
            self.reserve(max(0, size_bytes - old_bytes))
            handle = os.open(name, os.O_WRONLY | _NO_FOLLOW | _NO_WAIT, dir_fd=directory)
            try:
                os.ftruncate(handle, size_bytes)
            finally:
                os.close(handle)
        self.measure()

    # -- the quota

    def reserve(self, size_bytes: int) -> None:
        """Take bytes from the quota. Raises `OSError` ENOSPC."""
        assert self._quota is not None
        if self._used_bytes + size_bytes > self._quota.size_bytes:
            _fail(errno.ENOSPC)
        self._used_bytes += size_bytes

    def _reserve_file(self) -> None:
        assert self._quota is not None
        if self._used_files + 1 > self._quota.files:
            _fail(errno.ENOSPC)
        self._used_files += 1

    def measure(self, tidy: bool = False) -> None:
        """Count what is there; with `tidy` remove unfinished uploads."""
        used_bytes = used_files = 0
        pending: list[FilePath] = [()]
        while pending:
            path = pending.pop()
            with suppress(OSError), self._directory(path) as directory, os.scandir(directory) as scan:
                for item in scan:
                    if tidy and item.name.startswith(_UNFINISHED):
                        with suppress(OSError):
                            os.unlink(item.name, dir_fd=directory)
                        continue
                    used_files += 1
                    status = item.stat(follow_symlinks=False)
                    if stat.S_ISDIR(status.st_mode):
                        pending.append((*path, item.name))
                    else:
                        used_bytes += status.st_size
                    if used_files > MAX_ENTRIES:
                        pending.clear()
                        break
        self._used_bytes, self._used_files = used_bytes, used_files

    # -- finding things

    def _must_be_writable(self) -> None:
        if self._quota is None:
            _fail(errno.EROFS)

    @contextmanager
    def _directory(self, path: FilePath) -> Iterator[int]:
        """A handle of a directory, reached step by step without following a link."""
        handle = os.open(self._root, _DIRECTORY_FLAGS)
        try:
            for name in path:
                parent, handle = handle, -1
                try:
                    handle = os.open(name, _DIRECTORY_FLAGS | _NO_FOLLOW, dir_fd=parent)
                finally:
                    os.close(parent)
            yield handle
        finally:
            if handle >= 0:
                os.close(handle)

    @contextmanager
    def _parent(self, path: FilePath) -> Iterator[tuple[int, str]]:
        """A handle of the directory that something is in, and its name there."""
        if not path:
            _fail(errno.EISDIR)
        if path[-1].startswith(_UNFINISHED):
            _fail(errno.EACCES)
        with self._directory(path[:-1]) as directory:
            yield directory, path[-1]

    @staticmethod
    def _status(directory: int, name: str, directories: bool = False) -> os.stat_result:
        """Of a plain file, or of a directory where those are wanted, too; raises `OSError` for everything else."""
        status = os.stat(name, dir_fd=directory, follow_symlinks=False)
        if stat.S_ISDIR(status.st_mode):
            if not directories:
                _fail(errno.EISDIR)
        elif not stat.S_ISREG(status.st_mode):
            _fail(errno.EACCES)
        return status

    def _size(self, directory: int, name: str) -> int:
        try:
            return self._status(directory, name).st_size
        except FileNotFoundError:
            return 0


# ---------------------------------------------------------------------------------------------------------- mounts


class Mounts:
    """Trees put together under one root, e.g. ``{"/fs/microsd": sandbox, "/fs/microsd/log": logs, "/log": logs}``.

    What is mounted hides what is below it. The places themselves, and the directories that lead to them, can neither be
    removed nor renamed.
    """

    def __init__(self, mounts: Mapping[str, FileTree]) -> None:
        self._mounts = {parse_path(place.encode()): tree for place, tree in mounts.items()}

    @property
    def writable(self) -> bool:
        return any(tree.writable for tree in self._mounts.values())

    def _find(self, path: FilePath) -> tuple[FileTree | None, FilePath]:
        """The tree that a path is in, and the path there."""
        for depth in range(len(path), -1, -1):
            tree = self._mounts.get(path[:depth])
            if tree is not None:
                return tree, path[depth:]
        return None, path

    def _is_place(self, path: FilePath) -> bool:
        return any(place[: len(path)] == path for place in self._mounts)

    def _change(self, path: FilePath) -> tuple[FileTree, FilePath]:
        """The writable tree that a path is in."""
        if self._is_place(path):
            _fail(errno.EACCES)
        tree, rest = self._find(path)
        if tree is None or not tree.writable:
            _fail(errno.EROFS)
        return tree, rest

    def entries(self, path: FilePath) -> list[Entry]:
        depth = len(path)
        children = {place[depth] for place in self._mounts if place[:depth] == path and len(place) > depth}
        found = {name: Entry(name, True, 0, 0.0) for name in children}
        tree, rest = self._find(path)
        if tree is None:
            if not children and path:
                _fail(errno.ENOENT)
        else:
            try:
                found = {entry.name: entry for entry in tree.entries(rest)} | found
            except OSError:
                if not self._is_place(path):
                    raise
        return [found[name] for name in sorted(found)]

    def open_read(self, path: FilePath) -> Reader:
        if self._is_place(path):
            _fail(errno.EISDIR)
        tree, rest = self._find(path)
        if tree is None:
            _fail(errno.ENOENT)
        return tree.open_read(rest)

    def open_write(self, path: FilePath, *, truncate: bool) -> Writer:
        tree, rest = self._change(path)
        return tree.open_write(rest, truncate=truncate)

    def remove(self, path: FilePath) -> None:
        tree, rest = self._change(path)
        tree.remove(rest)

    def rename(self, old: FilePath, new: FilePath) -> None:
        tree, from_path = self._change(old)
        other, to_path = self._change(new)
        if tree is not other:
            _fail(errno.EXDEV)
        tree.rename(from_path, to_path)

    def make_directory(self, path: FilePath) -> None:
        if self._is_place(path):
            _fail(errno.EEXIST)
        tree, rest = self._change(path)
        tree.make_directory(rest)

    def remove_directory(self, path: FilePath) -> None:
        tree, rest = self._change(path)
        tree.remove_directory(rest)

    def truncate(self, path: FilePath, size_bytes: int) -> None:
        tree, rest = self._change(path)
        tree.truncate(rest, size_bytes)
