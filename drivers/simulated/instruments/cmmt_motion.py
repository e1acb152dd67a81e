"""Motion of a CMMT drive: homing, jogging, or the positioning task of telegram 111."""

from __future__ import annotations

from collections.abc import Callable

from drivers.simulated.instruments.cmmt_parameters import CmmtParameters
from drivers.simulated.instruments.cmmt_reference import CmmtReference
from drivers.simulated.instruments.cmmt_settings import SimulatedCmmtSettings
from drivers.simulated.instruments.cmmt_telegram import OutputImage
from drivers.simulated.task_log import TaskLog
from drivers.simulated.world.axis import AxisCommand, SimulatedAxis
from drivers.simulated.world.drive import FARTHER_THAN_ANY_SWITCH_mm, MotionFaults

STOP_NOT_FOUND_WARNING = 279


class CmmtMotion:
    """The motion of an enabled drive: at most one of homing, jogging and a task at a time.

    A task lasts, also after its target has been reached, until another motion begins or `end`.
    """

    def __init__(
        self,
        settings: SimulatedCmmtSettings,
        axis: SimulatedAxis,
        reference: CmmtReference,
        parameters: CmmtParameters,
        faults: MotionFaults,
        tasks: TaskLog,
        log: Callable[[str, object, str], None],
    ):
        self.axis = axis
        self.reference = reference
        self.homing = False
        self.jogging = 0
        """Direction of jogging: 1, -1, or 0 for none."""
        self.target_mm: float | None = None
        """Target of the task, as a position of the World; None without one."""
        self.acknowledged = False
        """True if the latest request for a task was taken."""
        self.at_fixed_stop = False
        self.warning = 0
        self._paused = False
        """True if the task waits for the bit "no intermediate stop", and for a speed."""
        self._moving = False
        """True if a motion has begun whose end has not been seen."""
        self._settings, self._parameters = settings, parameters
        self._faults, self._tasks, self._log = faults, tasks, log

    @property
    def busy(self) -> bool:
        """True if there is something that the axis moves for, or has moved for."""
        return self.target_mm is not None or self.homing or bool(self.jogging)

    # --- what happens by itself ---------------------------------------------------------------

    def settle(self, t_us: int) -> None:
        """Note and log the end of a motion, if the axis has come to rest by the World time
        `t_us`."""
        if not self._moving or not self.axis.finished(t_us):
            return
        self._moving = False
        position = self.axis.position(t_us)
        self._log("at-rest", round(position, 6), "drive")
        if self.homing:
            self.homing = False
            self.reference.found(position)
            self._log("homed", True, "drive")
        elif self.seeking and not (self.at_fixed_stop or self._paused):
            self.warning = STOP_NOT_FOUND_WARNING  # UNCONFIRMED: may be parametrised as a fault

    def find_fixed_stop(self, t_us: int) -> None:
        """Note that the axis has met the stop that it seeks."""
        self.at_fixed_stop = True
        self._log("fixed-stop", round(self.axis.position(t_us), 6), "drive")

    @property
    def seeking(self) -> bool:
        """True if its task is a travel to a fixed stop."""
        return self.target_mm is not None and self.axis.seeks_fixed_stop

    # --- what an output image asks for --------------------------------------------------------

    def obey(self, before: OutputImage, image: OutputImage, t_us: int, by: str) -> int:
        """Stop, pause, home, jog, start or change a task, in this order of precedence; return the
        fault that the task causes, 0 for none."""
        if not image.bit(0, 4):
            if self._moving:
                self._log("stop", None, by)
            if self.busy:
                self.brake(image, t_us)
            self.end()
            return 0
        self._limit_force(image)
        if self.target_mm is not None and not image.bit(0, 5):
            if not self._paused:
                self.brake(image, t_us)
            self._paused = True
        elif self._paused:
            self._paused = False
            self._go(image, t_us, by)
        if image.bit(0, 11) and not before.bit(0, 11):
            self._home(t_us, by)
        elif self.homing and not image.bit(0, 11):
            self.brake(image, t_us)
            self.homing = False
        self._jog(image, t_us, by)
        if not image.bit(0, 6):
            self.acknowledged = False
        elif not before.bit(0, 6):
            return self._begin(image, t_us, by)
        elif image.bit(1, 12) and self.acknowledged and image.motion != before.motion:
            return self._begin(image, t_us, by, again=True)
        return 0

    def brake(self, image: OutputImage, t_us: int) -> None:
        """Begin a controlled stop, as the image asks for it."""
        self.axis.stop(t_us, image.deceleration * self._settings.full_acceleration_mm_s2)

    def end(self) -> None:
        """Forget what the axis moves for."""
        self.target_mm, self.homing, self.jogging = None, False, 0
        self.acknowledged = self._paused = False
        self._faults.runs_to_mm = None

    def _limit_force(self, image: OutputImage) -> None:
        """Set the force limit of a travel to fixed stop, from the clamping torque."""
        seeking, own = image.bit(3, 8), self._settings
        share = self._parameters.clamping_percent / 100  # percent UNCONFIRMED
        clamping_N = share * own.force_at_full_torque_N
        self.axis.seeks_fixed_stop = seeking
        self.axis.force_limit_N = clamping_N if seeking else own.mechanics.peak_force_N

    def _home(self, t_us: int, by: str) -> None:
        self.target_mm, self.homing, self.jogging = None, True, 0
        self.reference.homed = self._paused = False
        own = self._settings
        self._log("homing", own.home_mm, by)
        rate = own.full_acceleration_mm_s2
        self._start(AxisCommand(own.home_mm, own.homing_speed_mm_s, rate, rate), t_us)

    def _jog(self, image: OutputImage, t_us: int, by: str) -> None:
        """Move as long as one of the two bits is set, as far as the software limits let it."""
        way = image.bit(0, 8) - image.bit(0, 9)
        at_work = self.target_mm is not None and self._moving
        if way == self.jogging or self.homing or at_work:
            return
        self.target_mm, self._paused, self.jogging = None, False, way
        self._log("jog", way, by)
        if way == 0:
            self.brake(image, t_us)
            return
        limited = image.bit(2, 14) and self.reference.homed
        end = self.reference.limits_mm()[way > 0] if limited else way * FARTHER_THAN_ANY_SWITCH_mm
        rate = self._settings.full_acceleration_mm_s2
        self._start(AxisCommand(end, self._settings.jog_speed_mm_s, rate, rate), t_us)

    def _begin(self, image: OutputImage, t_us: int, by: str, again: bool = False) -> int:
        """Take the task in the image; what cannot be done is not acknowledged. Return its fault."""
        absolute, reference = image.bit(1, 8), self.reference
        if not image.bit(1, 15) or image.bit(1, 14) or self.homing or image.speed <= 0:
            self._log("refused", "not a positioning task", by)  # records, setup: not simulated
            return 0
        if absolute and not reference.homed:
            self._log("refused", "not homed", by)  # UNCONFIRMED
            return 0
        if absolute:
            target = reference.world_mm(image.target)
        else:
            target = image.target * self._settings.position_unit_mm + self.axis.position(t_us)
        if image.bit(2, 14) and reference.homed and (code := reference.limit_fault(target)):
            return code  # UNCONFIRMED: it may move as far as it can
        self.target_mm, self.acknowledged, self.jogging = target, True, 0
        if not again:
            self._tasks.begin(self._settings.name, t_us)
        self._go(image, t_us, by, quiet=again)
        return 0

    def _go(self, image: OutputImage, t_us: int, by: str, quiet: bool = False) -> None:
        """Move to the task's target, or wait where the image asks for a stop, or for no speed."""
        assert self.target_mm is not None
        if not image.bit(0, 5) or image.speed <= 0:
            self._paused = True
            return
        own = self._settings
        speed = image.speed * own.speed_unit_mm_s
        if not quiet:
            self._log("move", {"target_mm": round(self.target_mm, 6), "speed_mm_s": speed}, by)
        full = own.full_acceleration_mm_s2
        rates = image.acceleration * full, image.deceleration * full
        self._start(self._faults.command(self.target_mm, speed, *rates), t_us)

    def _start(self, command: AxisCommand, t_us: int) -> None:
        self.at_fixed_stop, self.warning, self._moving = False, 0, True
        self.axis.move(t_us, command)
