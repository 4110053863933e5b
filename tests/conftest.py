"""Of all tests."""

from __future__ import annotations

import signal

# Where the run itself ignores these, as behind nohup, the processes that it starts would too, and could not be ended.
for _number in (signal.SIGINT, signal.SIGHUP):
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, signal.default_int_handler if _number == signal.SIGINT else signal.SIG_DFL)
