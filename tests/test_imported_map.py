"""Maps of other programs: a map_server grid becomes keyframes that a scan is found in."""

import cv2
import numpy as np
import pytest
from tests.estimators.drives import RING, way
from tests.maps.drawn import mapped
from tests.recognition.halls import seen

from impslam.continuing import begin_with
from impslam.errors import ConfigError, ImpError
from impslam.imported_map import load_map, read_grid
from impslam.maps.files import map_image, write_map
from impslam.recognition.relocalisation import Relocaliser, Verdict
from impslam.recognition.submap import view

AT = np.array([10.0, 1.25, 0.4])


@pytest.fixture(scope="module")
def grid():
    return mapped(RING, way((3.0, 1.25), (18.75, 1.25), (18.75, 12.75), (1.25, 12.75))).grid()


@pytest.fixture
def yaml(grid, tmp_path):
    write_map(tmp_path, map_image(grid))
    return tmp_path / "map.yaml"


def found(known):
    answer = Relocaliser(known.keyframes).find(view(seen(RING, AT)))
    assert answer.verdict is Verdict.FOUND
    return answer.hypotheses[0].pose


def test_a_scan_is_found_in_a_grid(yaml):
    known = load_map(yaml)
    assert known.keyframes.placed.all()
    assert len(known.path()) == 0
    assert np.abs(found(known) - AT).max() < 0.08


def test_the_image_may_be_named_or_be_another(yaml):
    first = load_map(yaml.with_suffix(".pgm")).keyframes
    cv2.imwrite(str(yaml.with_suffix(".png")), cv2.imread(str(yaml.with_suffix(".pgm")), 0))
    yaml.write_text(yaml.read_text().replace("map.pgm", '"map.png"  # the same'))
    np.testing.assert_array_equal(load_map(yaml).keyframes.points, first.points)


def negative(yaml):
    """The map's image with light and dark exchanged, elsewhere."""
    folder = yaml.parent / "sub"
    folder.mkdir()
    pixels = cv2.imread(str(yaml.with_suffix(".pgm")), 0)
    cv2.imwrite(str(folder / "map.pgm"), 255 - pixels)
    return folder / "map.pgm"


@pytest.mark.parametrize("negate", ["1", "true", "True", "yes", '"1"'])
@pytest.mark.parametrize("is_absolute", [True, False])
def test_the_image_is_where_the_yaml_says_and_may_be_negated(yaml, negate, is_absolute):
    expected = read_grid(yaml)
    image = negative(yaml) if is_absolute else negative(yaml).relative_to(yaml.parent)
    text = yaml.read_text().replace("map.pgm", str(image))
    yaml.write_text(text.replace("negate: 0", f"negate: {negate}"))
    np.testing.assert_array_equal(read_grid(yaml).cells, expected.cells)


def test_any_notation_of_yaml_is_read(yaml):
    expected, text = read_grid(yaml), yaml.read_text()
    (line,) = (line for line in text.splitlines() if line.startswith("origin"))
    rows = "".join(f"\n  - {value}" for value in line[len("origin: [") : -1].split(", "))
    text = text.replace(line, f"origin:{rows}  # x, y, yaw").replace("trinary", '"scale"')
    yaml.write_text(f"%YAML 1.2\n---\n{text.replace('negate: 0', 'negate: false')}")
    np.testing.assert_array_equal(read_grid(yaml).cells, expected.cells)
    np.testing.assert_array_equal(read_grid(yaml).origin, expected.origin)


def test_a_grid_that_is_turned_is_found_turned(yaml):
    text = yaml.read_text()
    (origin,) = (line for line in text.splitlines() if line.startswith("origin"))
    yaml.write_text(text.replace(origin, "origin: [0.0, 0.0, 1.0]"))
    x, y, _ = (float(v) for v in origin.split("[")[1].strip("]").split(","))
    c, s = np.cos(1.0), np.sin(1.0)
    expected = [c * (AT[0] - x) - s * (AT[1] - y), s * (AT[0] - x) + c * (AT[1] - y), AT[2] + 1.0]
    assert np.abs(found(load_map(yaml)) - expected).max() < 0.1


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("map.pgm", "gone.pgm", "No such file"),
        ("mode: trinary", "mode: raw", "its mode is raw"),
        ("mode: trinary", 'mode: "raw"', "its mode is raw"),
        ("mode: trinary", "mode: foo", "its mode is foo, not trinary or scale"),
        ("mode: trinary", "mode: [trinary]", "its mode is not one value"),
        ("negate: 0", "negate: dark", "its negate is dark, neither 0 nor 1"),
        ("map.pgm", "/dev/zero", "/dev/zero is not a file"),
        ("map.pgm", "sub/map.pgm", r"No such file.*sub/map\.pgm"),
        ("origin: [", "origin: [1, ", "its origin is not a list of x, y and yaw"),
        ("origin: [", "origin: {x: ", "while parsing"),
        ("image", f"{'#' * 20_000}\nimage", "it is longer than 16384 bytes"),
        ("image", f"{'[' * 10_000}\nimage", "recursion"),
        ("image", "- image", "not a map_server map"),
        ("resolution: 0.05", "resolution: 0", "is invalid"),
        ("resolution: 0.05", "resolution: x", "could not convert"),
        ("origin", "begin", "origin"),
        ("free_thresh: 0.196", "free_thresh: -1", "has no free space"),
    ],
)
def test_a_grid_that_cannot_be_used_is_told_in_a_line(yaml, old, new, said):
    yaml.write_text(yaml.read_text().replace(old, new))
    with pytest.raises(ImpError, match=said) as error:
        load_map(yaml)
    assert "\n" not in str(error.value)


def test_images_that_are_cut_or_none_are_told_or_read(yaml):
    whole = yaml.with_suffix(".pgm").read_bytes()
    for data in (
        b"",
        b"P5",
        whole[:40],
        whole[: len(whole) // 2],
        b"\0" * 100,
        b"P5 900000 900000 255\n",
    ):
        yaml.with_suffix(".pgm").write_bytes(data)
        with pytest.raises(ImpError):
            load_map(yaml)


def test_what_a_grid_and_a_graph_cannot_do_is_told(yaml, tmp_path):
    with pytest.raises(ConfigError, match="add --frozen"):
        begin_with(yaml)
    with pytest.raises(ImpError, match="has no scans to localise in"):
        begin_with(tmp_path / "graph.g2o", frozen=True)
