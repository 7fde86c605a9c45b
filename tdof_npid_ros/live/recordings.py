"""Recorders that the page begins and ends."""

from __future__ import annotations

import time
from pathlib import Path

from tdof_npid_ros.graph.processes import NodeProcesses


class Recordings:
    """Recordings of one loop, one at a time.

    Args:
        namespace: of the loop.
        parameter_file: whatever the recorder reads of it.
    """

    def __init__(self, namespace: str, parameter_file: Path) -> None:
        self._namespace, self._file = namespace, parameter_file
        self._recorder: NodeProcesses | None = None
        self._bag: Path | None = None

    @property
    def runs(self) -> bool:
        """Whether something is being recorded."""
        return self._recorder is not None

    def switch(self, on: bool) -> str:
        """Begin or end a recording; what to tell of it."""
        if on and self._recorder is None:
            self._bag = Path("bags") / f"live-{time.strftime('%Y%m%d-%H%M%S')}"
            self._recorder = NodeProcesses(self._file, self._namespace)
            self._recorder.start("recorder", {"bag": str(self._bag)})
            return f"recording to {self._bag}"
        if not on and self._recorder is not None:
            self.close()
            return f"recorded: {self._bag}; tdof-npid analyze {self._bag}"
        return ""

    def close(self) -> None:
        """End what records."""
        if self._recorder is not None:
            self._recorder.stop()
            self._recorder = None
