"""A DDS domain for one test at a time."""

from __future__ import annotations

import fcntl
import itertools
import random
import tempfile
from pathlib import Path
from typing import IO

DOMAINS = range(1, 80)  # used in turn, so that a killed node's remains are gone when its domain comes round again
DOMAIN_NUMBERS = itertools.cycle(random.sample(DOMAINS, len(DOMAINS)))


def reserved_domain() -> tuple[int, IO[str]]:
    """A DDS domain that no other test on this machine uses now; it is free again when the file is closed."""
    for domain in DOMAIN_NUMBERS:
        file = (Path(tempfile.gettempdir()) / f"tdof-npid-domain-{domain}.lock").open("w")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.close()
        else:
            return domain, file
    raise AssertionError("a cycle does not end")
