"""What goes wrong beside the flights, which keep their own errors in their rows."""

from __future__ import annotations

from mavsitl.errors import MavsitlError, UsageError


class GridError(UsageError):
    """What is to be swept is not understood; the message names it and what is allowed."""


class CampaignError(MavsitlError, RuntimeError):
    """A campaign cannot go on; the message says why and what to do."""


class StoreError(CampaignError):
    """What is on the disk cannot be used; the message names the file."""


class WorkerError(CampaignError):
    """The workers cannot work; the message names them."""


class MissingError(CampaignError):
    """A library is not installed; the message has the line that installs it."""
