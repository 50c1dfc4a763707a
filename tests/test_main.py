"""The command line."""

import errno
import os
import subprocess
import sys

import pytest
from helpers import slow_beyond

from jaxbridge.__main__ import COMMAND


def run(*arguments, cwd, **environment):
    command = [sys.executable, "-m", "jaxbridge", *arguments]
    in_haste = {**os.environ, "JAX_DISABLE_MOST_OPTIMIZATIONS": "1", "XLA_FLAGS": "", **environment}
    options = dict(capture_output=True, text=True, timeout=600)
    return subprocess.run(command, cwd=cwd, env=in_haste, **options)


@pytest.mark.slow
def test_quick_run_prints_a_table_and_writes_pictures(tmp_path):
    arguments = ("approximate", "--quick", "--out", "pictures", "--seed", "3")
    done = run(*arguments, cwd=tmp_path, JAX_COMPILATION_CACHE_DIR="")
    assert done.returncode == 0, done.stderr
    assert "(--quick: expect larger errors" in done.stdout
    assert "2,000 bridges a case" in done.stdout
    assert done.stdout.count("as published") >= 8
    assert "[16/16]" in done.stderr
    assert "Written to pictures: bridges.png, " in done.stdout and "Read next: " in done.stdout
    assert len(list((tmp_path / "pictures").glob("*.png"))) == 9
    assert len(list((tmp_path / "pictures" / "programs").iterdir())) > 20


@pytest.mark.slow
def test_quick_run_of_the_exact_studies(tmp_path):
    for part, words, pictures in (
        ("exact", ("pseudo-marginal", "renewal"), 2),
        ("cost", ("per effective bridge",), 3),
        ("variation", ("std/mean",), 4),
    ):
        done = run(part, "--quick", "--out", "pictures", cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        assert all(word in done.stdout for word in words) and "nan" not in done.stdout
        assert len(list((tmp_path / "pictures").glob("*.png"))) == pictures


@pytest.mark.parametrize(
    "arguments",
    slow_beyond(1, [["--out", "a-file"], ["--sed", "1"], ["--seed", "-1"], ["--seed", "x"]]),
)
def test_bad_arguments_end_with_one_line(arguments, tmp_path):
    (tmp_path / "a-file").touch()
    done = run(*arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1
    assert done.stderr.startswith("python -m jaxbridge: ")


def test_a_full_disk_ends_with_one_line_and_no_part_of_a_file(tmp_path, capsys):
    with COMMAND.writing(tmp_path / "first.json") as path:
        path.write_text("{}")
    with pytest.raises(SystemExit), COMMAND.writing(tmp_path / "second.json") as path:
        path.write_text("{")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert [file.name for file in tmp_path.iterdir()] == ["first.json"]
    (line,) = capsys.readouterr().err.splitlines()
    assert "second.json: No space left on device" in line


def test_help(tmp_path):
    done = run("--help", cwd=tmp_path)
    assert done.returncode == 0
    assert all(option in done.stdout for option in ("--quick", "--seed", "--out"))
