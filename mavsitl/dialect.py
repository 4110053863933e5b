"""The one import of pymavlink.

Everything about MAVLink messages (ids, CRC extras, layouts, enums) comes from pymavlink's generated `development`
dialect. `mavutil` is never imported: it keeps global state, reads the wall clock and costs 170 ms.
"""

from pymavlink.dialects.v20 import development as mavlink

__all__ = ["mavlink"]
