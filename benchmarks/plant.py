"""A tool in a soft grip on a turning wrist, and a torque sensor that looks at it late: no more than the loop needs.

    wrist speed → (delay) → angle → gel spring that relaxes, with slip → torque → sensor that averages, lags and errs

Times in s from 0; the angle of the wrist and the true torque are 0 at the start. All randomness is the generator's.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from shearloop.daemon.control.creep import Creep
from shearloop.drivers.eit_format import FRAME_PERIOD_S
from shearloop.drivers.emulators.twin import Twin


@dataclass(frozen=True, slots=True, kw_only=True)
class Tool:
    """What is gripped. The torque at a fixed angle relaxes by `relaxing_share`, with a time constant."""

    stiffness_nm_per_rad: float = 0.25
    relaxing_share: float = 0.06
    relaxing_s: float = 5.0
    slip_nm: float = np.inf
    actuation_s: float = 0.02


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensor:
    """How the torque is measured: the mean of a window, every period, known `transfer_s` after the window's end."""

    period_s: float
    window_s: float
    transfer_s: float
    jitter_s: float = 0.0
    noise_nm: float = 0.0
    # The gel's reading falls by this share under a constant torque, and has play.
    relaxing_share: float = 0.0
    relaxing_s: float = 20.0
    play_nm: float = 0.0
    dropped_share: float = 0.0


# As the shipped experiments grip.
GRIP_FORCE_N = 60.0

EIT = Sensor(
    period_s=FRAME_PERIOD_S,
    window_s=FRAME_PERIOD_S,
    transfer_s=0.05,
    jitter_s=0.02,
    noise_nm=0.012,
    relaxing_share=0.03,
    play_nm=0.002,
)
LOAD_CELL = Sensor(period_s=1 / 10.9, window_s=1 / 10.9, transfer_s=0.01, jitter_s=0.005, noise_nm=0.0005)


@dataclass(frozen=True, slots=True)
class Sample:
    """One measurement: the torque, the middle of its window, and when it is known."""

    torque_nm: float
    t_mid_s: float
    t_s: float


@dataclass(slots=True)
class Plant:
    """Advances by one command period at a time; `samples` holds what is measured and not yet collected."""

    tool: Tool
    sensor: Sensor
    rng: np.random.Generator
    period_s: float = 0.008
    disturbance_nm: float = 0.0
    blocked: bool = False  # the robot does not turn, whatever it is sent
    t_s: float = 0.0
    angle_rad: float = 0.0
    torque_nm: float = 0.0
    _under_way: list[float] = field(default_factory=list)
    _relaxed_nm: float = 0.0
    _slipped_rad: float = 0.0
    _read_relaxed_nm: float = 0.0
    _read_nm: float = 0.0
    _window_integral: float = 0.0
    _next_end_s: float = 0.0
    _samples: list[Sample] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Set the sensor and the actuation delay going."""
        # Where in its period the board is when the experiment begins is anyone's guess.
        self._next_end_s = self.sensor.window_s + self.rng.uniform(0.0, self.sensor.period_s)
        self._under_way = [0.0] * (int(self.tool.actuation_s / self.period_s) + 1)

    def step(self, speed_rad_per_s: float) -> None:
        """Send a wrist speed and let one command period pass."""
        part = self.tool.actuation_s / self.period_s % 1.0
        self._under_way.append(0.0 if self.blocked else speed_rad_per_s)
        earlier = self._under_way.pop(0)
        self.angle_rad += self.period_s * ((1.0 - part) * self._under_way[0] + part * earlier)
        self._load()
        self._measure()

    def collect(self) -> list[Sample]:
        """Return the measurements that have become known by now, each once."""
        known = [sample for sample in self._samples if sample.t_s <= self.t_s]
        if known:
            self._samples = [sample for sample in self._samples if sample.t_s > self.t_s]
        return known

    def _load(self) -> None:
        """Bring spring, relaxation and slip up to the wrist's angle."""
        tool = self.tool
        elastic = tool.stiffness_nm_per_rad * (self.angle_rad - self._slipped_rad)
        towards = tool.relaxing_share * elastic - self._relaxed_nm
        self._relaxed_nm += towards * self.period_s / tool.relaxing_s
        torque = elastic - self._relaxed_nm
        if abs(torque) > tool.slip_nm:
            excess = torque - np.sign(torque) * tool.slip_nm
            self._slipped_rad += float(excess) / tool.stiffness_nm_per_rad
            torque -= float(excess)
        self.torque_nm = torque + self.disturbance_nm

    @property
    def stiffness_nm_per_rad(self) -> float:
        """Return the true stiffness between wrist and base."""
        return self.tool.stiffness_nm_per_rad

    def _sensed(self) -> float:
        return self._read_nm - self._read_relaxed_nm

    def _feel(self) -> None:
        """Bring what the sensor sees of the torque up to the present."""
        sensor, half_play = self.sensor, 0.5 * self.sensor.play_nm
        self._read_nm = min(max(self._read_nm, self.torque_nm - half_play), self.torque_nm + half_play)
        towards = sensor.relaxing_share * self._read_nm - self._read_relaxed_nm
        self._read_relaxed_nm += towards * self.period_s / sensor.relaxing_s

    def _measure(self) -> None:
        sensor, before_nm = self.sensor, self._sensed()
        self._feel()
        after_nm = self._sensed()
        start_s, self.t_s = self.t_s, self.t_s + self.period_s
        opens_s = self._next_end_s - sensor.window_s
        while self._next_end_s <= self.t_s:
            self._window_integral += _overlap(start_s, self.t_s, before_nm, after_nm, opens_s, self._next_end_s)
            self._finish(after_nm)
            opens_s = self._next_end_s - sensor.window_s
        self._window_integral += _overlap(start_s, self.t_s, before_nm, after_nm, opens_s, self._next_end_s)

    def _finish(self, latest_nm: float) -> None:
        sensor, end_s = self.sensor, self._next_end_s
        mean = self._window_integral / sensor.window_s if sensor.window_s else latest_nm
        dropped = self.rng.random() < sensor.dropped_share
        noise, late_s = self.rng.normal(0.0, 1.0) * sensor.noise_nm, self.rng.uniform(0.0, 1.0) * sensor.jitter_s
        if not dropped:
            known_s = end_s + sensor.transfer_s + late_s
            self._samples.append(Sample(mean + noise, end_s - 0.5 * sensor.window_s, known_s))
        self._window_integral = 0.0
        self._next_end_s += sensor.period_s


@dataclass(slots=True)
class TwinPlant(Plant):
    """The same with the emulated rig's own physics: its gel that creeps and lags, its grip that slips, its lever.

    A sensor that `sees_gel` (a fingertip) sees the gel's shear, any other one the torque itself.
    """

    twin: Twin = field(default_factory=Twin)
    sees_gel: bool = True
    # Takes the gel's creep out of each sample, as the loop does.
    creep: Creep | None = None

    @property
    def stiffness_nm_per_rad(self) -> float:
        """Return that of gel and joint in series, on a fresh gel."""
        own = self.twin.settings
        return 1.0 / (1.0 / own.gel_stiffness_nm_per_rad + 1.0 / own.joint_stiffness_nm_per_rad)

    def collect(self) -> list[Sample]:
        """Return the measurements that have become known by now, each once."""
        known = Plant.collect(self)
        if self.creep is None:
            return known
        return [
            replace(sample, torque_nm=self.creep.torque_nm(sample.torque_nm, round(sample.t_mid_s * 1e9)))
            for sample in known
        ]

    def _load(self) -> None:
        self.twin.kick_nm = self.disturbance_nm
        self.torque_nm = self.twin.step(self.period_s, self.angle_rad, GRIP_FORCE_N).torque_nm

    def _feel(self) -> None:
        state = self.twin.state
        self._read_nm = state.shear_torque_nm if self.sees_gel else state.torque_nm


def _overlap(start_s: float, end_s: float, first: float, last: float, low_s: float, high_s: float) -> float:
    """Return the integral, over the part of a step within a window, of what goes from `first` to `last` in it."""
    low, high = max(start_s, low_s), min(end_s, high_s)
    if high <= low:
        return 0.0
    middle = (0.5 * (low + high) - start_s) / (end_s - start_s)
    return (first + (last - first) * middle) * (high - low)
