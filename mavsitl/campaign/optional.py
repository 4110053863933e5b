"""Libraries that only sweeps need, and that `pip install mavsitl` does not bring."""

from __future__ import annotations

from importlib.util import find_spec

from mavsitl.campaign.errors import MissingError

PURPOSES = {"pyarrow": "results in Parquet", "distributed": "a Dask cluster"}


def need(module: str) -> None:
    """Raises `MissingError` where it is not installed."""
    if find_spec(module) is None:
        raise MissingError(
            f"{module} is not installed, which {PURPOSES[module]} needs: pip install 'mavsitl[sweep]'"
        )  # fmt: skip
