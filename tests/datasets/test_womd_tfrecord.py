"""TFRecord framing against a bitwise CRC-32C and damage at every place."""

from __future__ import annotations

import gzip
import struct
import zlib

import pytest

from drivax.datasets.womd.tfrecord import count_records, looks_framed, mask_crc, read_records, write_record
from drivax.errors import DataError, UsageError

PAYLOADS = (b"first", b"", b"third record", b"x" * 300)


@pytest.fixture
def good(wire):
    return b"".join(wire.frame(payload) for payload in PAYLOADS)


@pytest.fixture
def read(tmp_path):
    def read_bytes(data: bytes):
        path = tmp_path / "some.tfrecord"
        path.write_bytes(data)
        return list(read_records(path)), path

    return read_bytes


def one_error(records):
    errors = [(number, item) for number, item in records if isinstance(item, DataError)]
    assert len(errors) == 1
    return errors[0]


def test_masked_crc_of_known_values(wire):
    # RFC 3720 B.4: CRC-32C of 32 zero bytes and of "123456789".
    assert wire.crc32c(bytes(32)) == 0x8A9136AA
    assert wire.crc32c(b"123456789") == 0xE3069283
    # Worked by hand: rotating 1 right by 15 gives 2**17.
    assert mask_crc(1) == 0x20000 + 0xA282EAD8
    assert mask_crc(0xFFFFFFFF) == 0xA282EAD7


def test_reads_records_with_numbers(good, read):
    records, _ = read(good)
    assert records == list(enumerate(PAYLOADS))


def test_a_flipped_bit_of_any_byte_is_noticed(good, read, wire):
    starts = [0]
    for payload in PAYLOADS:
        starts.append(starts[-1] + len(wire.frame(payload)))
    for position in range(len(good)):
        data = bytearray(good)
        data[position] ^= 1 << position % 8
        records, path = read(bytes(data))
        damaged = next(i for i in range(len(PAYLOADS)) if position < starts[i + 1])
        number, error = one_error(records)
        assert number == damaged == error.record
        assert error.file == path and error.cure
        in_payload = position - starts[damaged] >= 12
        survivors = [item for _, item in records if isinstance(item, bytes)]
        kept = PAYLOADS[:damaged] + (PAYLOADS[damaged + 1 :] if in_payload else ())
        assert survivors == list(kept)


def test_truncation_at_every_offset(good, read, wire):
    starts = [0]
    for payload in PAYLOADS:
        starts.append(starts[-1] + len(wire.frame(payload)))
    for size in range(1, len(good)):
        records, _ = read(good[:size])
        whole = sum(size >= start for start in starts[1:])
        assert [item for _, item in records if isinstance(item, bytes)] == list(PAYLOADS[:whole])
        if size in starts:
            assert len(records) == whole
        else:
            number, error = one_error(records)
            assert number == whole and "truncated" in str(error) and f"record {whole}" in str(error)


def test_empty_file_is_reported_as_one_bad_record(read):
    records, path = read(b"")
    assert (
        str(one_error(records)[1]) == f"{path}: record 0: the file is empty; copy or download the file again"
    )


@pytest.mark.parametrize(("compress", "word"), [(gzip.compress, "gunzip"), (zlib.compress, "zlib")])
def test_compressed_file_names_the_cure(good, read, compress, word):
    number, error = one_error(read(compress(good))[0])
    assert number == 0 and "compressed" in str(error) and word in str(error.cure)


def test_other_files_are_refused(read):
    assert "not a TFRecord file" in str(one_error(read(b"<html>not found</html>" * 9)[0])[1])


@pytest.mark.parametrize("length", [2**31 - 1, 2**31, 2**62, 2**64 - 1])
def test_18_huge_length_is_not_allocated(length, good, read, wire):
    """Check-list 18, size limits: a length is compared with the file's size before anything is read."""
    header = struct.pack("<Q", length)
    records, _ = read(good + header + wire.masked_crc(header) + b"some bytes")
    number, error = one_error(records)
    assert number == len(PAYLOADS) and "truncated" in str(error)


def test_counts_by_lengths_alone(good, tmp_path, wire):
    path = tmp_path / "some.tfrecord"
    path.write_bytes(good)
    assert count_records(path) == len(PAYLOADS)
    path.write_bytes(good[:-1])
    assert count_records(path) == len(PAYLOADS) - 1  # the last one is cut off
    header = struct.pack("<Q", 2**63)
    path.write_bytes(good + header + wire.masked_crc(header) + bytes(40))
    assert count_records(path) == len(PAYLOADS)
    path.write_bytes(b"")
    assert count_records(path) == count_records(tmp_path / "none") == count_records(tmp_path) == 0


def test_framing_is_detected_by_the_first_header(good, tmp_path):
    path = tmp_path / "some.tfrecord"
    path.write_bytes(good)
    assert looks_framed(path)
    for place in range(12):
        data = bytearray(good)
        data[place] ^= 4
        path.write_bytes(bytes(data))
        assert not looks_framed(path)
    for content in (b"", good[:11], b"SQLite format 3\0" * 4):
        path.write_bytes(content)
        assert not looks_framed(path)
    assert not looks_framed(tmp_path / "none") and not looks_framed(tmp_path)


def test_missing_file_is_reported(tmp_path):
    with pytest.raises(DataError, match="file not found"):
        next(read_records(tmp_path / "none"))


def test_missing_package_names_the_extra(good, read, hide_packages):
    hide_packages("google_crc32c")
    with pytest.raises(UsageError, match=r"drivax\[womd\]"):
        read(good)


def test_records_longer_than_any_real_one_are_refused(tmp_path):
    """Parsed, a record of empty messages takes 50 times its length."""
    path = tmp_path / "some.tfrecord"
    with path.open("wb") as file:
        for payload in (b"ok", bytes((32 << 20) + 1)):
            write_record(file, payload)
    records = list(read_records(path))
    assert records[0] == (0, b"ok")
    number, error = one_error(records)
    assert number == 1 and error.file == path
    assert error.problem == "the record has 34 MB, more than the 34 MB that are read"
