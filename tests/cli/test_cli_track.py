"""`imp track`: what it refuses, in one line each."""


def test_missing_files_are_named(imp, tmp_path) -> None:
    video, out = tmp_path / "film.mp4", tmp_path / "truth.tum"
    for options, told in (
        (["-o", tmp_path / "truth.csv"], "give -o NAME.tum"),
        (["-o", out], "no such video"),
    ):
        said = imp("track", video, *options)
        assert said.code == 2
        assert told in said.err
    video.write_bytes(b"nothing")
    said = imp("track", video, "-o", out)
    assert said.code == 2
    assert "name the setup of the camera with --setup FILE" in said.err
    assert not out.exists()
