"""Recorders that the page begins and ends."""

from __future__ import annotations

import time
from pathlib import Path

from tdof_npid_ros.graph.processes import NodeProcessError, NodeProcesses


class Recordings:
    """Recordings of one loop, one at a time.

    Args:
        namespace: of the loop.
        parameter_file: whatever the recorder reads of it.

    Attributes:
        told: what there is to tell of the latest one, to all pages.
        failed: whether that is why there is no such recording.
    """

    def __init__(self, namespace: str, parameter_file: Path) -> None:
        self._namespace, self._file = namespace, parameter_file
        self._recorder: NodeProcesses | None = None
        self._bag = Path()
        self.told, self.failed = "", False

    @property
    def runs(self) -> bool:
        """Whether something is being recorded, as far as `look` has seen."""
        return self._recorder is not None

    def look(self) -> None:
        """See whether the recorder still runs; it ends by itself if it cannot record."""
        try:
            if self._recorder is not None:
                self._recorder.check()
        except NodeProcessError as error:
            self._recorder = None
            self._tell(str(error), failed=True)

    def switch(self, on: bool) -> None:
        """Begin or end a recording."""
        self.look()
        if on and self._recorder is None:
            self._start()
        elif not on and self._recorder is not None:
            self.close()
            if self._bag.exists():
                self._tell(f"recorded: {self._bag}; tdof-npid analyze {self._bag}")
            else:
                self._tell("nothing is recorded: the recorder had not begun yet", failed=True)

    def close(self) -> None:
        """End what records."""
        if self._recorder is not None:
            self._recorder.stop()
            self._recorder = None

    def _start(self) -> None:
        names = ["live", *filter(None, self._namespace.split("/")), time.strftime("%Y%m%d-%H%M%S")]
        self._bag = Path("bags") / "-".join(names)
        try:
            recorder = NodeProcesses(self._file, self._namespace)
            recorder.start("recorder", {"bag": str(self._bag)})
        except (ValueError, OSError) as error:
            self._tell(str(error), failed=True)
        else:
            self._recorder = recorder
            self._tell(f"recording to {self._bag}")

    def _tell(self, text: str, failed: bool = False) -> None:
        self.told, self.failed = text, failed
