"""Other tools' data formats, one module each."""
