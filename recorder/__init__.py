"""The log: recording it, reading it, and what viewers show of it.

    environment  -> wrapper -> rows, display        -> log_writer -> mcap_writer -> file
    environments -> vector_wrapper -> vector_rows   -> log_writer -> mcap_writer -> file
    dataset      -> save                            -> log_writer -> mcap_writer -> file
    file -> mcap_reader -> reader -> dataset -> statistics, tables
                        -> check
    damaged file -> salvage -> valid_copy -> whole_episodes -> file   (recover)

`chunks`, `message_rows`, `schema` and `messages` are the codec of both directions, `spaces` and
`metadata` say what is in a log, `scene` and `layout` what a viewer makes of it.
"""
