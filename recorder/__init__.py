"""Recording, reading and display of logs.

Arrows show how data flows through the modules:

    environment  -> wrapper        -> step_rows, display -> log_writer -> writer -> file
    environments -> vector_wrapper -> step_rows, display -> log_writer -> writer -> file
    dataset      -> save                                 -> log_writer -> writer -> file
    file -> reader -> log_reader -> dataset -> statistics, tables
                   -> check
    bag -> bags -> mapping -> dataset                                 (convert)
    damaged file -> salvage -> recover -> file

`chunks`, `records`, `schema` and `messages` encode and decode logs. `spaces` and `metadata`
describe the contents of a log. `scene` and `layout` define what viewers show.
"""

from mcaprl.lazy import lazy_attributes

__all__ = [
    "EPISODE_TOPIC",
    "MAPPING_SECTIONS",
    "STEP_TOPIC",
    "ChunkHeader",
    "Compressors",
    "LogReader",
    "McapReader",
    "Player",
    "Track",
    "chunk_header",
    "clear_types",
    "crc32",
    "map_file",
    "message_dtype",
    "open_bag",
    "step_schema",
]

# The modules below are imported when one of their names is first used.
__getattr__ = lazy_attributes(
    __name__,
    {
        "mcaprl.recorder.bags.bag": ("open_bag",),
        "mcaprl.recorder.columns.cdr": ("clear_types",),
        "mcaprl.recorder.columns.chunks": ("ChunkHeader", "Compressors", "chunk_header"),
        "mcaprl.recorder.columns.reader": ("McapReader",),
        "mcaprl.recorder.columns.records": ("crc32", "map_file"),
        "mcaprl.recorder.dataset.log_reader": ("LogReader",),
        "mcaprl.recorder.format.schema": (
            "EPISODE_TOPIC",
            "STEP_TOPIC",
            "message_dtype",
            "step_schema",
        ),
        "mcaprl.recorder.mapping.config": ("MAPPING_SECTIONS",),
        "mcaprl.recorder.viewer.playback": ("Player", "Track"),
    },
)
