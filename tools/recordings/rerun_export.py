"""Writes a recording for the Rerun viewer: scalars with their intervals, images of the bank's match, and the robot."""

import os
import tempfile
import threading
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from shearloop.bank.fingertip import Fingertip
from shearloop.daemon.messaging.messages import ENVELOPE, EitEstimate, EitHeatmap, RobotStateMessage
from shearloop.daemon.recorder import schema
from shearloop.daemon.web.message_store import conductivity_profile
from shearloop.extras import require
from shearloop.files import replace_file
from shearloop.tools.recordings.intact_records import Progress
from shearloop.tools.recordings.reader import columns_of_topics, read_messages
from shearloop.tools.recordings.recorded_columns import TopicColumns

TIMELINE = "time"
# Values of an entity that are sent at once, and images.
_BATCH, _IMAGE_BATCH = 1000, 30
_COPIED_BYTES = 1 << 16
# Longer arrays are frames and heatmaps.
_LONGEST_SCALARS = 8
_POSE = 6
_NOT_SHOWN = (*ENVELOPE, "scores", schema.SCORES_SHAPE)
# The charts, each of one unit.
_CHARTS = {"N·m": "torque (N·m)", "mm": "diameter (mm)", "N": "shear force (N)", "rad": "angle (rad)"}


class _Copy(threading.Thread):
    """Copies a pipe into a file, and reads the pipe to its end even if the file accepts no more.

    The SDK writes files in a thread. On a full disk that thread ends, and a program that waits for it waits forever. So
    the SDK writes to a pipe.
    """

    def __init__(self, pipe: int, out: IO[bytes]) -> None:
        """Take the pipe's descriptor, which the copy closes."""
        super().__init__(name="rerun", daemon=True)
        self._pipe, self._out = pipe, out
        self._error: OSError | None = None

    def run(self) -> None:
        """Copy until the writer has closed the pipe."""
        with open(self._pipe, "rb") as pipe:
            while data := pipe.read(_COPIED_BYTES):
                if self._error is None:
                    try:
                        self._out.write(data)
                    except OSError as error:
                        self._error = error

    def end(self) -> None:
        """Wait for the end of the pipe; raises OSError if the file did not take everything."""
        self.join()
        if self._error is not None:
            raise self._error


class _RerunFile:
    """Adds messages to a Rerun file, in batches."""

    def __init__(self, out: IO[bytes], folder: Path, fingertip: Fingertip, columns: Mapping[str, TopicColumns]) -> None:
        """Take the file, an empty folder, and the columns of each topic."""
        import rerun

        self._rr = rerun
        self._columns_of = columns
        self._height_cm = fingertip.height_cm
        self._width_cm = float(np.ptp([x for x, _ in fingertip.outline().contour]))
        # The SDK may be switched off by an environment variable, and would then write nothing.
        self._stream = rerun.RecordingStream("shearloop", default_enabled=True)
        pipe = folder / "pipe"
        os.mkfifo(pipe)
        # Opened before its writer, and read from once that has opened it.
        reading = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
        try:
            self._stream.save(pipe)
        except BaseException:
            os.close(reading)
            raise
        os.set_blocking(reading, True)
        self._copy = _Copy(reading, out)
        self._copy.start()
        self._waiting: dict[str, tuple[list[int], list[Any]]] = {}
        self._models: dict[str, str] = {}
        self._images: set[str] = set()
        self._poses: set[str] = set()
        # By entity.
        self._units: dict[str, str] = {}

    def add(self, topic: str, content: Mapping[str, Any], t_ns: int) -> None:
        """Add one message of a recorded topic."""
        entity, columns = self._rr.new_entity_path(topic.split(".")).lstrip("/"), self._columns_of[topic]
        for key, value in content.items():
            if (isinstance(value, list) and len(value) > _LONGEST_SCALARS) or key in _NOT_SHOWN:
                continue
            if isinstance(value, bool | int | float | list):
                self._units.setdefault(f"{entity}/{key}", columns.units.get(key, ""))
                self._add(f"{entity}/{key}", value, t_ns)
        self._draw(entity, columns.name, columns.known(content), t_ns)

    def _draw(self, entity: str, live: str | None, content: Mapping[str, Any], t_ns: int) -> None:
        """Add the image or the pose of a message, if it has what is drawn."""
        if live == EitHeatmap.topic:
            self._models[content["source"]] = content["model"] or ""
            scores, sides = content["scores"], content[schema.SCORES_SHAPE]
            if scores is not None and sides is not None:
                shape = [int(side) for side in sides]
                self._add_image(f"{entity}/scores", np.array(scores, float).reshape(shape), t_ns)
        elif live == EitEstimate.topic and content["k"] is not None and content["sigma"] is not None:
            model = self._models.get(content["source"], "")
            profile = conductivity_profile(model, content["k"], content["sigma"], self._height_cm)
            if profile is not None:
                # The top comes first, and twice the untouched gel's is white.
                column = np.array(profile)[::-1, None] / 2
                width = round(len(column) * self._width_cm / self._height_cm)
                self._add_image(f"{entity}/conductivity", np.repeat(column, width, axis=1), t_ns)
        elif live == RobotStateMessage.topic:
            pose: list[float] = content["tcp_pose"] or []
            if len(pose) == _POSE and None not in pose:
                self._add_pose(f"{entity}/tool_centre", pose, t_ns)

    def close(self) -> None:
        """Write what waits, and the layout of the viewer; raises OSError where the disk does not take it."""
        try:
            for entity in self._waiting:
                self._send(entity)
            self._stream.send_blueprint(self._layout())
            self._stream.flush()
        finally:
            # The copy ends with the pipe's writer.
            self._stream.disconnect()
            self._copy.end()

    def _add(self, entity: str, value: Any, t_ns: int) -> None:
        times, values = self._waiting.setdefault(entity, ([], []))
        # The values of a batch have one shape.
        if values and np.shape(values[0]) != np.shape(value) and entity not in self._images:
            self._send(entity)
        times.append(t_ns)
        values.append(value)
        if len(times) == (_IMAGE_BATCH if entity in self._images else _BATCH):
            self._send(entity)

    def _send(self, entity: str) -> None:
        times, waiting = self._waiting[entity]
        if times:
            index = self._rr.TimeColumn(TIMELINE, timestamp=np.array(times, "datetime64[ns]"))
            self._stream.send_columns(entity, [index], self._columns(entity, waiting))
        times.clear()
        waiting.clear()

    def _columns(self, entity: str, waiting: list[Any]) -> Any:
        rr = self._rr
        if entity in self._images:
            sizes = [{"height": len(pixels), "width": len(pixels.T)} for pixels in waiting]
            formats = [rr.components.ImageFormat(**size, color_model="L", channel_datatype="U8") for size in sizes]
            return rr.Image.columns(buffer=[pixels.tobytes() for pixels in waiting], format=formats)
        # A number that is not finite is null in a recording.
        values = np.array(waiting, dtype=np.float64)
        if entity in self._poses:
            turns = values[:, 3:]
            half = np.linalg.norm(turns, axis=1, keepdims=True) / 2
            quaternions = np.hstack([turns / 2 * np.sinc(half / np.pi), np.cos(half)])
            return rr.Transform3D.columns(translation=values[:, :3], quaternion=quaternions)
        return rr.Scalars.columns(scalars=values)

    def _add_image(self, entity: str, share: NDArray[np.floating[Any]], t_ns: int) -> None:
        """Add a grey image; 0 and NaN are black, 1 is white."""
        pixels = np.round(255 * np.fmin(np.fmax(share, 0), 1)).astype(np.uint8)
        self._images.add(entity)
        self._add(entity, pixels, t_ns)

    def _add_pose(self, entity: str, pose: list[float], t_ns: int) -> None:
        if entity not in self._poses:
            self._poses.add(entity)
            self._stream.log(entity, self._rr.TransformAxes3D(0.1), static=True)
        self._add(entity, pose, t_ns)

    def _layout(self) -> Any:
        from rerun import blueprint

        charted = {
            name: [entity for entity in self._waiting if self._units.get(entity) == unit]
            for unit, name in _CHARTS.items()
        }
        charts = [blueprint.TimeSeriesView(name=name, contents=lines) for name, lines in charted.items() if lines]
        images = [blueprint.Spatial2DView(name=entity, origin=entity) for entity in sorted(self._images)]
        poses = [blueprint.Spatial3DView(name=entity, contents=[entity]) for entity in sorted(self._poses)]
        columns = [blueprint.Vertical(*views) for views in (charts, [*images, *poses]) if views]
        return blueprint.Blueprint(blueprint.Horizontal(*columns))


def export_rerun(
    path: Path, out: Path, topics: list[str], fingertip: Fingertip, progress: Progress = lambda _: None
) -> Path:
    """Write topics of a recording as a .rrd file and return it; the conductivity is drawn for `fingertip`.

    Raises OSError for a file that cannot be written, UserError without rerun-sdk and for an unreadable recording.
    """
    require("rerun", "rerun", "a file for Rerun")
    columns = columns_of_topics(path, topics)
    with (
        replace_file(out) as written,
        tempfile.TemporaryDirectory() as folder,
        closing(_RerunFile(written, Path(folder), fingertip, columns)) as file,
    ):
        for topic, content, message in read_messages(path, topics, progress):
            file.add(topic, content, message.log_time)
    return out
