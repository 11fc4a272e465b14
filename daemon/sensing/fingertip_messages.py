"""Messages of the EIT fingertips."""

import asyncio
from dataclasses import asdict
from operator import attrgetter

import numpy as np

from shearloop.daemon.messaging.messages import EitAdapted, EitEstimate, EitFrame, EitHeatmap
from shearloop.drivers.eit_kit import Frame
from shearloop.estimation import Adaptation, Estimate, Session


def frame_message(name: str, frame: Frame) -> EitFrame:
    """Return the message of a frame."""
    return EitFrame(
        source=name,
        t_mono_ns=frame.t_mid_ns,
        channels=frame.channels,
        line=frame.raw,
        frame=frame.seq,
        age_s=(frame.t_arrival_ns - frame.t_mid_ns) / 1e9,
        saturated=int(np.count_nonzero(frame.saturated)),
        dead=int(np.count_nonzero(frame.dead)),
        repeated=frame.repeated,
    )


async def heatmap_message(name: str, frame: Frame, session: Session) -> EitHeatmap | None:
    """Return the message of a frame that the session has just taken, None without a bank; a thread computes it."""
    scores, search = await asyncio.to_thread(session.heatmap), session.search
    if scores is None or search is None:
        return None
    return EitHeatmap(
        source=name,
        t_mono_ns=frame.t_mid_ns,
        scores=scores,
        k_low=float(search.k_grid[0]),
        k_high=float(search.k_grid[-1]),
        sigma_low=float(search.sigma_grid[0]),
        sigma_high=float(search.sigma_grid[-1]),
        model=search.model,
        frame=frame.seq,
    )


def adapted_message(name: str, frames: tuple[Frame, ...], reference: str, adaptation: Adaptation) -> EitAdapted:
    """Return the message of a correction that begins with the frames of one time."""
    correction, before, after = adaptation.correction, adaptation.before, adaptation.after
    return EitAdapted(
        source=name,
        t_mono_ns=_mean_ns(frames),
        reference=reference,
        twists=correction.twists,
        factor=tuple(correction.factors.tolist()),
        factor_std=tuple(correction.errors.tolist()),
        offset_nm=correction.offset_nm,
        gain_before=before.gain,
        gain_after=after.gain,
        rmse_before_nm=before.rmse_nm,
        rmse_after_nm=after.rmse_nm,
        spread_before=before.spread,
        spread_after=after.spread,
        frame=frames[0].seq,
    )


def _mean_ns(frames: tuple[Frame, ...]) -> int:
    return sum(frame.t_mid_ns for frame in frames) // len(frames)


def estimate_message(name: str, frames: tuple[Frame, ...], estimate: Estimate, now_ns: int) -> EitEstimate:
    """Return the message of an estimate from frames of one time, as published at now_ns."""
    values = asdict(estimate)
    del values["reasons"], values["lag_s"]
    return EitEstimate(
        source=name,
        t_mono_ns=_mean_ns(frames),
        **values,
        reason="; ".join(estimate.reasons),
        frame=frames[0].seq,
        latency_s=(now_ns - max(map(attrgetter("t_arrival_ns"), frames))) / 1e9,
    )
