"""Progress where standard error is no terminal."""

from mcsim.support.progress import reporting


def test_work_that_grows_is_one_line(capsys):
    with reporting("fitted effects", 0.0, "skies") as report:
        for done in range(1, 21):
            report.expect(8.0)
            report(8.0 * done)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert "fitted effects: 160/160 skies" in lines[0]


def test_a_stage_without_work_says_nothing(capsys):
    with reporting("fitted effects", 0.0, "skies"):
        pass
    assert capsys.readouterr().err == ""


def test_work_of_known_size_ends_in_a_line(capsys):
    with reporting("chunks", 2.0, "chunks") as report:
        report(1.0)
        report(2.0)
        report(2.0)  # of a part that has none
    assert capsys.readouterr().err.count("chunks: 2/2") == 1
