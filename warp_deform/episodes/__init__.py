"""The one dataset format: an immutable, sealed Parquet file per episode.

Demonstrations, evaluation episodes and goals share it. `EpisodeWriter` adds files to a folder,
`EpisodeReader` reads them at random with bounded memory. Workers on any number of machines may
write into one folder, and merging two datasets is copying files. Nothing is ever unpickled.
"""

from ._control_rows import CONTROL, ControlRecord, ControlRow
from ._folder import (
    EpisodeReader,
    EpisodeWriter,
    episode_name,
    read_index,
    rebuild_index,
)
from ._provenance import (
    combine_hashes,
    cpu_fingerprint,
    state_hash,
    versions,
)
from ._records import (
    CONTROL_FORMAT,
    FORMAT,
    HEIGHT_UNIT,
    MAX_HEIGHT,
    Episode,
    EpisodeInfo,
    Goal,
    Step,
)

__all__ = [
    "CONTROL",
    "CONTROL_FORMAT",
    "FORMAT",
    "HEIGHT_UNIT",
    "MAX_HEIGHT",
    "ControlRecord",
    "ControlRow",
    "Episode",
    "EpisodeInfo",
    "EpisodeReader",
    "EpisodeWriter",
    "Goal",
    "Step",
    "combine_hashes",
    "cpu_fingerprint",
    "episode_name",
    "read_index",
    "rebuild_index",
    "state_hash",
    "versions",
]
