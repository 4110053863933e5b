"""The formats that a log is written in, by the ending of a name; apart from what does it, which loads numpy."""

ENDINGS = {
    ".csv.zip": "comma-separated values, a file for each topic",
    ".csv": "comma-separated values, one topic",
    ".parquet.zip": "Parquet, a file for each topic (the extra sweep)",
    ".parquet": "Parquet, one topic (the extra sweep)",
    ".jsonl": "JSON lines, all rows by time",
    ".mcap": "MCAP for Foxglove: all topics, and the flight in 3D (the extra mcap)",
    ".ulg": "ULog: of a run both ends' logs as one",
}
"""The longer of two that fit comes first."""

ONE_TOPIC = (".csv", ".parquet")
"""Those of a single table."""
