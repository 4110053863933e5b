"""Control laws: pure classes with no clock and no message, each citing its equations, the fleet axis n last."""
