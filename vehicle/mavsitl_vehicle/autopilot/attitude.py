"""The stock attitude loop: quaternion error to body rates, with yaw weighted below roll and pitch as PX4 does."""

from __future__ import annotations

from math import sqrt

from mavsitl.compiled import compiled


@compiled
def quaternion_product(
    aw: float, ax: float, ay: float, az: float, bw: float, bx: float, by: float, bz: float
) -> tuple[float, float, float, float]:
    """Hamilton product a b, scalar first."""
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


@compiled
def attitude_error(
    w: float, x: float, y: float, z: float, dw: float, dx: float, dy: float, dz: float, yaw_weight: float
) -> tuple[float, float, float]:
    """Rotation vector (small-angle, 2 x the vector part) from attitude q to the setpoint d, in body FLU axes, rad.

    The setpoint is split into the shortest turn that points the thrust axis (tilt) and the turn about that axis which
    remains (yaw); the yaw turn is scaled by `yaw_weight` before both are joined again.
    """
    ew, ex, ey, ez = quaternion_product(w, -x, -y, -z, dw, dx, dy, dz)
    # e = tilt * yaw with yaw = (cw, 0, 0, cz): the swing-twist decomposition of e about the body's z axis
    norm = sqrt(ew * ew + ez * ez)
    if norm < 1e-9:
        return 2.0 * ex, 2.0 * ey, 0.0
    if ew < 0.0:
        norm = -norm
    cw, cz = ew / norm, ez / norm
    tw, tx, ty, tz = quaternion_product(ew, ex, ey, ez, cw, 0.0, 0.0, -cz)
    # half-angle scaled in its sine: exact at weights 0 and 1, within 2 % below a quarter turn
    sz = yaw_weight * cz
    sw = sqrt(1.0 - sz * sz)
    rw, rx, ry, rz = quaternion_product(tw, tx, ty, tz, sw, 0.0, 0.0, sz)
    sign = 2.0 if rw >= 0.0 else -2.0
    return sign * rx, sign * ry, sign * rz
