"""MCAP through the Foxglove SDK: every topic as it is, and the flight in Foxglove's own words, so that it opens in 3D.

The scene's frame is ``world``, NWU, the vehicle's is ``vehicle``, FLU: x forward, y left, z up, as Foxglove draws.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mavsitl import __version__
from mavsitl.frames import flip_quaternion, flip_vector
from mavsitl.log import topics
from mavsitl.log.content import Content, Table
from mavsitl.log.convert import documents, in_order
from mavsitl.log.errors import LogError

if TYPE_CHECKING:
    import foxglove

WORLD, VEHICLE, REFERENCE = "world", "vehicle", "reference"

FRAMES_US = 20_000
"""Between two poses; 3D needs no more."""
TRAIL_US = 100_000
"""Between two points of a path."""
ARM_M, ROTOR_RADIUS_M, HUB_M = 0.25, 0.12, 0.1
"""Of the vehicle that is drawn, whatever flew."""

_TYPES = {"f": "number", "u": "integer", "i": "integer", "b": "boolean", "U": "string"}
_COLOURS = {VEHICLE: (0.34, 0.71, 0.91, 1.0), REFERENCE: (0.84, 0.37, 0.0, 0.8)}


def write_mcap(out: Path, content: Content) -> None:
    """Raises `LogError` where the SDK is not there."""
    try:
        import foxglove
    except ImportError as error:
        raise LogError("MCAP needs the Foxglove SDK: pip install 'mavsitl[mcap]'") from error
    logging.getLogger("foxglove").setLevel(logging.ERROR)
    zero_us = int(content.information.get("boot_time_utc_us", 0))
    context = foxglove.Context()
    with foxglove.open_mcap(str(out), context=context) as writer:
        writer.write_metadata("log", {key: str(value) for key, value in content.information.items()})
        writer.write_metadata("parameters", {name: str(value) for name, value in content.parameters.items()})
        _write_topics(context, content, zero_us)
        if content.kind == "ULog":
            _Scene(context, content, zero_us).write()


def _write_topics(context: foxglove.Context, content: Content, zero_us: int) -> None:
    import foxglove

    made = {name: documents(table) for name, table in content.tables.items()}
    channels = {
        name: foxglove.Channel(f"/{name}", schema=_schema(name, table), context=context)
        for name, table in content.tables.items()
    }
    for stamp, name, row in in_order(content):
        channels[name].log(made[name][row], log_time=(zero_us + stamp) * 1000)


def _schema(name: str, table: Table) -> dict[str, Any]:
    """JSON schema of a row."""
    properties: dict[str, Any] = {}
    for column, values in table.items():
        kind = {"type": _TYPES.get(values.dtype.kind, "string")}
        properties[column] = kind if values.ndim == 1 else {"type": "array", "items": kind}
    return {"title": name, "type": "object", "properties": properties}


class _Scene:
    """Poses, paths, the wind and the texts."""

    def __init__(self, context: foxglove.Context, content: Content, zero_us: int) -> None:
        self._context = context
        self._content = content
        self._zero_us = zero_us

    def write(self) -> None:
        from foxglove.channels import FrameTransformChannel, PoseInFrameChannel, SceneUpdateChannel

        moved = self._pose(topics.LOCAL_POSITION_TRUTH.key, topics.ATTITUDE_TRUTH.key)
        if moved is None:
            moved = self._pose(topics.LOCAL_POSITION.key, topics.ATTITUDE.key)
        scene = SceneUpdateChannel("/scene", context=self._context)
        if moved is not None:
            stamps, positions, attitudes = moved
            transforms = FrameTransformChannel("/tf", context=self._context)
            poses = PoseInFrameChannel("/pose", context=self._context)
            self._show(scene, VEHICLE, int(stamps[0]), self._quadrotor())
            self._show(scene, "path", int(stamps[0]), {"lines": [self._path(stamps, positions, VEHICLE)]}, WORLD)
            for stamp, position, attitude in zip(stamps.tolist(), positions.tolist(), attitudes.tolist(), strict=True):
                self._log_pose(transforms, poses, stamp, position, attitude)
        reference = self._content.tables.get(topics.TRAJECTORY_SETPOINT.key)
        if reference is not None:
            stamps, positions = _thinned(reference["timestamp"], _flipped(reference["position"]), TRAIL_US)
            self._show(scene, REFERENCE, int(stamps[0]), {"lines": [self._path(stamps, positions, REFERENCE)]}, WORLD)
        self._write_locations()
        self._write_texts()

    def _pose(self, position_key: str, attitude_key: str) -> tuple[Any, Any, Any] | None:
        """Times, positions NWU (k, 3) and quaternions FLU -> NWU (k, 4), thinned; None: not both were logged."""
        tables = self._content.tables
        if position_key not in tables or attitude_key not in tables:
            return None
        position, attitude = tables[position_key], tables[attitude_key]
        common, rows, beside = np.intersect1d(position["timestamp"], attitude["timestamp"], return_indices=True)
        if not common.size:
            return None
        where = _flipped(np.column_stack([position[axis][rows] for axis in "xyz"]))
        turned = np.column_stack(flip_quaternion(*attitude["q"][beside].T))
        stamps, both = _thinned(common, np.hstack((where, turned)).astype(np.float64), FRAMES_US)
        return stamps, both[:, :3], both[:, 3:]

    def _time(self, stamp_us: int) -> Any:
        from foxglove.messages import Timestamp

        us = self._zero_us + stamp_us
        return Timestamp(us // 1_000_000, us % 1_000_000 * 1000)

    def _log_pose(self, transforms: Any, poses: Any, stamp: int, position: list[float], attitude: list[float]) -> None:
        from foxglove.messages import FrameTransform, Pose, PoseInFrame, Quaternion, Vector3

        w, x, y, z = attitude
        where, turned = Vector3(x=position[0], y=position[1], z=position[2]), Quaternion(x=x, y=y, z=z, w=w)
        time, log_time = self._time(stamp), (self._zero_us + stamp) * 1000
        transforms.log(
            FrameTransform(
                timestamp=time, parent_frame_id=WORLD, child_frame_id=VEHICLE, translation=where, rotation=turned
            ),
            log_time=log_time,
        )
        poses.log(
            PoseInFrame(timestamp=time, frame_id=WORLD, pose=Pose(position=where, orientation=turned)),
            log_time=log_time,
        )

    def _show(self, scene: Any, name: str, stamp: int, parts: dict[str, Any], frame: str = VEHICLE) -> None:
        from foxglove.messages import SceneEntity, SceneUpdate

        entity = SceneEntity(timestamp=self._time(stamp), frame_id=frame, id=name, frame_locked=True, **parts)
        scene.log(SceneUpdate(entities=[entity]), log_time=(self._zero_us + stamp) * 1000)

    def _quadrotor(self) -> dict[str, Any]:
        """In plus form: rotor 1 rear, 2 right, 3 front, which is orange, 4 left."""
        from foxglove.messages import Color, CubePrimitive, CylinderPrimitive, Pose, Quaternion, Vector3

        level = Quaternion(x=0.0, y=0.0, z=0.0, w=1.0)

        def colour(name: str) -> Color:
            r, g, b, a = _COLOURS[name]
            return Color(r=r, g=g, b=b, a=a)

        def at(x: float, y: float, z: float) -> Pose:
            return Pose(position=Vector3(x=x, y=y, z=z), orientation=level)

        rotors = [
            CylinderPrimitive(
                pose=at(x * ARM_M, y * ARM_M, 0.03),
                size=Vector3(x=2 * ROTOR_RADIUS_M, y=2 * ROTOR_RADIUS_M, z=0.01),
                bottom_scale=1.0,
                top_scale=1.0,
                color=colour(REFERENCE if x > 0 else VEHICLE),
            )
            for x, y in ((-1, 0), (0, -1), (1, 0), (0, 1))
        ]
        body = [
            CubePrimitive(pose=at(0.0, 0.0, 0.0), size=Vector3(x=length, y=width, z=0.02), color=colour(VEHICLE))
            for length, width in ((2 * ARM_M, 0.02), (0.02, 2 * ARM_M), (HUB_M, HUB_M))
        ]
        return {"cylinders": rotors, "cubes": body}

    def _path(self, stamps: Any, positions: Any, colour: str) -> Any:
        from foxglove.messages import Color, LinePrimitive, LinePrimitiveLineType, Point3

        _, thin = _thinned(stamps, positions, TRAIL_US)
        r, g, b, a = _COLOURS[colour]
        return LinePrimitive(
            type=LinePrimitiveLineType.LineStrip,
            thickness=2.0,
            scale_invariant=True,
            points=[Point3(x=x, y=y, z=z) for x, y, z in thin.astype(np.float64).tolist()],
            color=Color(r=r, g=g, b=b, a=a),
        )

    def _write_locations(self) -> None:
        """For the map."""
        from foxglove.channels import LocationFixChannel
        from foxglove.messages import LocationFix

        table = self._content.tables.get(topics.GPS_POSITION.key)
        if table is None:
            return
        channel = LocationFixChannel("/location", context=self._context)
        columns = (table[name].tolist() for name in ("timestamp", "latitude_deg", "longitude_deg", "altitude_msl_m"))
        for stamp, latitude, longitude, altitude in zip(*columns, strict=True):
            fix = LocationFix(
                timestamp=self._time(stamp), frame_id=VEHICLE, latitude=latitude, longitude=longitude, altitude=altitude
            )
            channel.log(fix, log_time=(self._zero_us + stamp) * 1000)

    def _write_texts(self) -> None:
        from foxglove.channels import LogChannel
        from foxglove.messages import Log, LogLevel

        levels = {
            "DEBUG": LogLevel.Debug, "INFO": LogLevel.Info, "NOTICE": LogLevel.Info, "WARNING": LogLevel.Warning,
            "ERROR": LogLevel.Error,
        }  # fmt: skip
        channel = LogChannel("/log", context=self._context)
        for stamp, level, text in self._content.texts:
            message = Log(
                timestamp=self._time(stamp), level=levels.get(level, LogLevel.Fatal), message=text,
                name=f"mavsitl {__version__}", file="", line=0,
            )  # fmt: skip
            channel.log(message, log_time=(self._zero_us + stamp) * 1000)


def _flipped(vectors: Any) -> Any:
    """(k, 3) NED as NWU."""
    return np.column_stack(flip_vector(*vectors.T))


def _thinned(stamps: Any, values: Any, every_us: int) -> tuple[Any, Any]:
    """The first row of each stretch of time, and the last of all."""
    chosen = np.append(np.flatnonzero(np.diff(stamps.astype(np.int64) // every_us, prepend=-1)), stamps.size - 1)
    return stamps[chosen], values[chosen]
