"""The log: recording it, reading it, and what viewers show of it.

    environment -> wrapper -> rows, display -> log_writer -> mcap_writer -> file
    dataset     -> save                     -> log_writer -> mcap_writer -> file
    file -> mcap_reader -> reader -> dataset -> statistics, tables
                        -> check

`chunks`, `schema` and `messages` are the codec of both directions, `spaces` and `metadata` say what
is in a log, `scene` and `layout` what a viewer makes of it.
"""
