"""Non-penetration and Coulomb friction of the skin on its core: a semismooth Newton method on the contact nodes.

With u = W λ + u₀ at n contact nodes (radial components first, then circumferential) the conditions are

    radial:           0 ≤ λ_n,  0 ≤ u_n,  λ_n u_n = 0
    circumferential:  |λ_t| ≤ μ λ_n,  λ_t = −μ λ_n sign(u_t − u_t,before) where that difference is not 0.

Both are written as one piecewise linear equation Φ(λ) = 0 (Alart & Curnier 1991; Hüeber, Stadler & Wohlmuth, SIAM
J. Sci. Comput. 30 (2008)). Each Newton step guesses which nodes are apart, stick or slip, solves the linear system
that belongs to the guess, and goes along it as far as Φ falls.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.bank.errors import BankError
from shearloop.bank.skin.annulus import CondensedSkin

# Random starts at a friction of 1 take up to about 45 steps, a step of loading 3 to 25.
MAX_STEPS = 200
# Thick skins, nearly incompressible ones and a friction of 1 sometimes need another start.
RESTARTS = 6
# Rounds of relaxation before one; each costs as much as a Newton step or two.
SWEEPS = 20
# Of the largest contact force: about a thousand roundings.
TOLERANCE = 1e-11
# Below this fraction of a step Φ does not fall: two pieces of it pass the step to and fro.
SHORTEST_STEP = 1e-2
# Then the whole step is taken, and Φ weighs displacement against force anew, which moves its pieces' borders.
WEIGHTS = (1.0, 3.0, 0.3)


class ContactError(BankError):
    """The contact conditions could not be met."""


@dataclass(frozen=True, slots=True, eq=False)
class ContactState:
    """The skin at rest under a load: contact forces (2n,) in N, circumferential displacements (n,) in mm."""

    normal_n: float
    shear_n: float
    contact_force_n: FloatArray
    along_mm: FloatArray
    newton_steps: int = 0

    @property
    def touching(self) -> BoolArray:
        """The (n,) nodes that press on the core; the others have lifted off."""
        pressing: BoolArray = self.contact_force_n[: len(self.along_mm)] > 0
        return pressing


def unloaded(skin: CondensedSkin) -> ContactState:
    """Return the skin as it is mounted: without load, without contact force."""
    n = len(skin.contact_deg)
    return ContactState(0.0, 0.0, np.zeros(2 * n), np.zeros(n))


def load(
    skin: CondensedSkin,
    before: ContactState,
    normal_n: float,
    shear_n: float,
    *,
    friction: float | None = None,
    start_force_n: FloatArray | None = None,
) -> ContactState:
    """Return the state after one increment of load (N) from `before`; friction is the section's unless given.

    The Newton iteration starts from the contact forces `start_force_n` (2n,), by default those of `before`.
    Raises ContactError where it does not converge.
    """
    friction = skin.section.friction if friction is None else friction
    start = before.contact_force_n if start_force_n is None else start_force_n
    free = skin.load_displacement @ (normal_n, shear_n)
    force, steps = solve_contact(skin.compliance, free, before.along_mm, friction, start)
    n = len(before.along_mm)
    return ContactState(normal_n, shear_n, force, skin.compliance[n:] @ force + free[n:], steps)


def follow(skin: CondensedSkin, normal_n: float, shear_n: Iterable[float]) -> list[ContactState]:
    """Return the states along a path of shear forces; the normal force alone is applied first, from the unloaded skin.

    One state per shear force. Friction depends on the path: the paper's steps are 0.1 N.
    """
    state = load(skin, unloaded(skin), normal_n, 0.0)
    states = []
    for shear in shear_n:
        state = load(skin, state, normal_n, float(shear))
        states.append(state)
    return states


def midline_strain(skin: CondensedSkin, state: ContactState) -> FloatArray:
    """Return the (m,) circumferential strain at mid-thickness, at the angles `skin.midline_deg`."""
    return skin.midline_strain(state.contact_force_n, state.normal_n, state.shear_n)


def gauge_strains(skin: CondensedSkin, states: Iterable[ContactState]) -> FloatArray:
    """Return the (states, 2) mean circumferential strains of the two gauges."""
    return np.array([skin.gauge_weights @ midline_strain(skin, state) for state in states])


def solve_contact(
    compliance: FloatArray, displacement: FloatArray, along_before: FloatArray, friction: float, start: FloatArray
) -> tuple[FloatArray, int]:
    """Return the contact forces (2n,) in N of one increment, and the Newton steps they took.

    `compliance` (2n, 2n) mm/N, `displacement` (2n,) mm without contact, `along_before` (n,) mm at the last
    increment, `start` (2n,) N. Raises ContactError where no solution is found.
    """
    if not (np.isfinite(displacement).all() and np.isfinite(start).all()):
        raise ContactError("The skin is loaded with what is no number; give its normal and shear force in N.")
    problem = _Problem(compliance, displacement, along_before, friction)
    rng = np.random.default_rng(0)
    force, steps, found = _newton(problem, start)
    for attempt in range(RESTARTS):
        if found:
            break
        # The guesses go round in a circle: begin where each node has met its own conditions, or somewhere else.
        start = rng.normal(0.0, abs(force).max(), len(force)) if attempt % 2 else problem.relaxed(force)
        force, more, found = _newton(problem, start)
        steps += more
    if not found:
        raise ContactError(
            f"The contact of the skin did not converge in {steps} steps at a friction of {friction}; "
            "apply the load in smaller steps."
        )
    return force, steps


def _newton(problem: "_Problem", force: FloatArray) -> tuple[FloatArray, int, bool]:
    """Return the forces that one start leads to, the steps taken, and whether they meet the conditions."""
    weight = 0
    residual, guess = problem.residual(force, WEIGHTS[weight])
    smallest = np.finfo(np.float64).tiny
    for step in range(MAX_STEPS):
        size = np.linalg.norm(residual)
        if size <= max(TOLERANCE * abs(force).max(), smallest):
            return force, step, True
        towards = problem.solve(guess) - force
        length = 1.0
        while length >= SHORTEST_STEP:
            new_residual, new_guess = problem.residual(force + length * towards, WEIGHTS[weight])
            if np.linalg.norm(new_residual) <= (1 - 1e-4 * length) * size:
                break
            length /= 2
        else:
            length, weight = 1.0, (weight + 1) % len(WEIGHTS)
            new_residual, new_guess = problem.residual(force + towards, WEIGHTS[weight])
        force, residual, guess = force + length * towards, new_residual, new_guess
    return force, MAX_STEPS, False


class _Guess(NamedTuple):
    touching: BoolArray
    # Sign of λ_t where a node slips, 0 where it sticks; means nothing at a node that does not touch.
    slipping: FloatArray


class _Problem:
    def __init__(
        self, compliance: FloatArray, displacement: FloatArray, along_before: FloatArray, friction: float
    ) -> None:
        self.n = len(along_before)
        self.compliance = compliance
        self.displacement = displacement
        self.along_before = along_before
        self.friction = friction
        # Turns displacements into forces of their size; any positive number gives the same solution.
        self.stiffness = 1 / np.diag(compliance)

    def residual(self, force: FloatArray, weight: float) -> tuple[FloatArray, _Guess]:
        """Return Φ (2n,) in N, and the piece of it in which the forces lie."""
        n = self.n
        moved = self.compliance @ force + self.displacement
        moved[n:] -= self.along_before
        trial = force - weight * self.stiffness * moved
        pressing = np.maximum(trial[:n], 0.0)
        bound = self.friction * pressing
        wanted = np.concatenate([pressing, np.clip(trial[n:], -bound, bound)])
        slipping = np.sign(trial[n:]) * (abs(trial[n:]) >= bound)
        return force - wanted, _Guess(trial[:n] > 0, slipping)

    def relaxed(self, force: FloatArray) -> FloatArray:
        """Return the forces after some rounds in which each node in turn meets its own conditions (Gauss-Seidel)."""
        n, force = self.n, force.copy()
        for _ in range(SWEEPS):
            for node in range(n):
                force[node] = max(self._alone(force, node, 0.0), 0.0)
                bound = self.friction * force[node]
                force[n + node] = min(max(self._alone(force, n + node, self.along_before[node]), -bound), bound)
        return force

    def _alone(self, force: FloatArray, row: int, before_mm: float) -> float:
        """Return the component of the forces that, all others given, moves its node back to where it was."""
        moved_mm = self.compliance[row] @ force + self.displacement[row] - before_mm
        return float(force[row] - self.stiffness[row] * moved_mm)

    def solve(self, guess: _Guess) -> FloatArray:
        """Return the forces of a guess: u_n = 0 where touching; there u_t as before or λ_t = ±μ λ_n."""
        n, nodes = self.n, np.flatnonzero(guess.touching)
        sticking = n + nodes[guess.slipping[nodes] == 0]
        slip = self.friction * guess.slipping[nodes]
        rows = np.concatenate([nodes, sticking])
        by_pressing = self.compliance[np.ix_(rows, nodes)] + self.compliance[np.ix_(rows, n + nodes)] * slip
        matrix = np.hstack([by_pressing, self.compliance[np.ix_(rows, sticking)]])
        wanted = -self.displacement[rows]
        wanted[len(nodes) :] += self.along_before[sticking - n]
        try:
            solution = np.linalg.solve(matrix, wanted)
        except np.linalg.LinAlgError as error:
            raise ContactError(
                f"At a friction of {self.friction} the sliding skin wedges: its equations are singular."
            ) from error
        force = np.zeros(2 * n)
        force[nodes] = solution[: len(nodes)]
        force[n + nodes] = slip * force[nodes]
        force[sticking] = solution[len(nodes) :]
        return force
