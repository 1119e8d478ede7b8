"""A disk that is full, for one process: files that can't grow."""

import resource
from contextlib import contextmanager


@contextmanager
def files_end_at(size):
    """Let every write beyond so many bytes of a file fail with an OSError, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
