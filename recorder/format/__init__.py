"""The log format, version 1: topics, message schemas, spaces and metadata."""
