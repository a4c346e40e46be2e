"""Files with every combination of MCAP's optional features, with and without padded records."""

from __future__ import annotations

from pathlib import Path

import pytest
from mcap.reader import make_reader

from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.columns.summary import check_file
from tests.support.conformance import CONTENTS, Content, build, variants

VARIANTS = list(variants())


def name_of(variant: tuple[Content, frozenset[str]]) -> str:
    return "-".join([variant[0].name, *sorted(variant[1])])


def test_the_matrix_has_as_many_files_as_the_official_set() -> None:
    counts = {content.name: sum(c is content for c, _ in VARIANTS) for content in CONTENTS}
    assert len(VARIANTS) == 416
    assert counts == {
        "NoData": 6,
        "OneAttachment": 14,
        "OneMetadata": 14,
        "OneMessage": 154,
        "OneSchemalessMessage": 74,
        "TenMessages": 154,
    }


@pytest.mark.parametrize("variant", VARIANTS, ids=map(name_of, VARIANTS))
def test_each_file_is_read_as_described(
    variant: tuple[Content, frozenset[str]], tmp_path: Path
) -> None:
    content, features = variant
    path = tmp_path / "variant.mcap"
    path.write_bytes(build(content, features))
    reader = McapReader(path)
    assert reader.complete
    assert not check_file(reader)
    found = []
    for channel in reader.channels.values():
        assert (channel.id, channel.topic, channel.message_encoding) == (1, "example", "a")
        assert channel.metadata == {"foo": "bar"}
        found += list(reader.messages(channel))
        if content.has_schema:
            schema = reader.schema_of(channel)
            assert (schema.name, schema.encoding, schema.data) == ("Example", "c", b"\4\5\6")
    assert found == [(message.log_time, message.data) for message in content.messages]
    assert reader.attachment("myFile") == content.attachment
    assert reader.metadata.get("myMetadata") == content.metadata


@pytest.mark.parametrize("content", CONTENTS, ids=lambda content: content.name)
def test_the_files_are_valid_by_the_reader_of_mcap(content: Content, tmp_path: Path) -> None:
    path = tmp_path / "variant.mcap"
    features = {"ch", "mx", "chx", "rch"} if content.messages else set()
    features |= {"rsh"} if content.messages and content.has_schema else set()
    path.write_bytes(build(content, frozenset({"st", *features})))
    with path.open("rb") as file:
        found = [message.data for _, _, message in make_reader(file).iter_messages()]
    assert found == [message.data for message in content.messages]
