"""Files that hold either their old content or their new one, never half of each."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedRandom
from pathlib import Path


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[BufferedRandom]:
    """
    Write a file that appears whole or not at all, even if the process is killed meanwhile.

    The content goes to a hidden sibling, is forced to disk, and takes the name in one step. The
    sibling's name is fixed, so what a killed process left behind is overwritten by the next write.

    :param path: the file to create or to replace; its folder exists
    :return: the open sibling; when the block raises, ``path`` is left as it was
    :raises OSError: it can't be written, or is a folder or device
    """
    path = Path(path)
    if path.exists() and not path.is_file():  # the null device would be replaced
        raise OSError(f"{path} is a folder or device; name a file")
    sibling = path.with_name(f".{path.name}.tmp")
    try:
        with open(sibling, "w+b") as handle:
            yield handle
            handle.flush()
            os.fsync(handle.fileno())
        os.replace(sibling, path)
    except BaseException:
        sibling.unlink(missing_ok=True)
        raise
