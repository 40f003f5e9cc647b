"""The operator at a rig: a thread that watches pedal and SpaceMouse, whatever else the program is doing.

    with Operator(stages, pedal=pedal, spacemouse=mouse) as operator:
        operator.wait_for_start(stages["coarse"], ...)      # enable, jog, start
        ...                                                  # a press of the pedal stops all stages

The pedal stops, and what it stopped stays stopped until the enable switch was released and pressed anew.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from types import TracebackType

from adof_drivers.errors import LimitError, NotArmedError, StoppedError
from adof_drivers.pedal import StopPedal
from adof_drivers.safety import EnableLatch
from adof_drivers.spacemouse import JogState, SpaceMouse
from adof_drivers.stage import Stage

PERIOD_S = 0.004
ENABLE, START = 0, 1
"""Buttons of the SpaceMouse."""
_JOG_S = 0.02
_JOG_EXPIRES_S = 0.1
_DOUBT = "the stop pedal was pressed, or is gone"


class Operator:
    """A watch from `__enter__` to `__exit__`; all stages share its latch.

    Attributes
    ----------
    latch
        Open until the enable switch is pressed; without a SpaceMouse by `press()`.
    stopped_s
        When a stop was last sent because of the pedal, monotonic; None if never.
    """

    def __init__(
        self,
        stages: Mapping[str, Stage],
        *,
        pedal: StopPedal | None = None,
        spacemouse: SpaceMouse | None = None,
    ) -> None:
        self.latch = EnableLatch()
        self.stopped_s: float | None = None
        self._stages = stages
        self._pedal = pedal
        self._mouse = spacemouse
        self._jog: JogState | None = None
        self._pedal_pressed = False
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="operator", daemon=True)
        for stage in stages.values():
            stage.latch = self.latch

    def __enter__(self) -> Operator:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._closing.set()
        self._thread.join()

    def press(self) -> None:
        """Press the enable switch anew, for an operator who has none and agreed by other means.

        Raises
        ------
        NotArmedError
            The pedal says stop.
        """
        if self._pedal_pressed:
            raise NotArmedError(f"{_DOUBT}: let go of it, then enable again")
        self.latch.operator(False)
        self.latch.operator(True)

    def look(self) -> None:
        """Ask pedal and SpaceMouse once, and act; the thread does this all the time."""
        if self._pedal is not None:
            self._pedal_pressed = self._pedal.poll().stop
            # While it says stop the latch cannot be closed, whatever is pressed.
            if self._pedal_pressed and self.latch.armed:
                for stage in self._stages.values():
                    stage.emergency_stop(_DOUBT)
                self.stopped_s = time.monotonic()
        if self._mouse is not None:
            self._jog = self._mouse.poll()
            self.latch.operator(ENABLE in self._jog.buttons and not self._pedal_pressed)

    def _watch(self) -> None:
        while not self._closing.wait(PERIOD_S):
            self.look()

    def wait_for_start(
        self,
        stage: Stage,
        *,
        speed_um_per_s: float,
        speed_rad_per_s: float,
        ready: Callable[[], None] = lambda: None,
    ) -> dict[str, float]:
        """Let the SpaceMouse enable, jog this stage and start; return how far each axis was jogged.

        The puck's x, y, z move the axes of these names and its turn about z moves "theta". At its limit an
        axis stops.

        Parameters
        ----------
        ready
            Called once, when the latch has closed: what has to be done before anything can be jogged.

        Raises
        ------
        NotArmedError
            No SpaceMouse, or it is gone.
        """
        began: dict[str, float] | None = None
        jogging = False
        while True:
            time.sleep(_JOG_S)
            state = self._jog
            if self._mouse is None or (state is not None and not state.connected):
                raise NotArmedError("no SpaceMouse to enable with: connect it, or agree on the keyboard")
            if state is None or not self.latch.armed:
                continue
            if began is None:
                ready()
                began = stage.position()
            if START in state.buttons:
                stage.stop()
                stage.wait_until_still()
                ended = stage.position()
                return {axis: ended[axis] - began[axis] for axis in ended}
            x, y, z, _, _, about_z = state.axes
            wish = {"x": x, "y": y, "z": z, "theta": about_z}
            speeds = {"um": speed_um_per_s, "rad": speed_rad_per_s}
            asked = {n: wish.get(n, 0.0) * speeds[axis.unit] for n, axis in stage.axes.items()}
            if not any(asked.values()) and not jogging:
                continue
            jogging = any(asked.values())
            for name, velocity in asked.items():
                try:
                    stage.set_velocity({name: velocity}, expires_s=_JOG_EXPIRES_S)
                except LimitError:
                    stage.set_velocity({name: 0.0})
                except (StoppedError, NotArmedError):
                    break  # the pedal; the operator may enable anew
