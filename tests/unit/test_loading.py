"""Files that are read once: again when they are other files."""

import os

import pytest

from mcsim.support.loading import once_per_content


def test_a_file_is_read_again_when_it_is_written_anew(tmp_path) -> None:
    times = []

    @once_per_content(2)
    def read(path, more: str = "") -> str:
        """Read a file."""
        times.append(path)
        return path.read_text() + more

    path = tmp_path / "mask"
    path.write_text("one")
    assert [read(path), read(path), read(path, "!")] == ["one", "one", "one!"]
    assert len(times) == 2
    path.write_text("three")
    assert read(path) == "three"
    # Of the same size: the time says it.
    path.write_text("seven")
    os.utime(path, ns=(1, 1))
    assert read(path) == "seven"
    path.unlink()
    with pytest.raises(FileNotFoundError):
        read(path)
