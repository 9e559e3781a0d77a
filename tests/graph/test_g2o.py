import numpy as np
import pytest
from benchmarks.g2o import read_g2o
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests.graph.pose_graphs import errors_of, random_graph

from impslam.errors import SourceError
from impslam.geometry.angles import wrap
from impslam.geometry.se2 import between, compose, inverse
from impslam.graph.g2o import G2o, write_g2o

GOOD = """# a comment
VERTEX_SE2 7 0 0 0
VERTEX_SE2 -3 1 0 1.5
FIX 7
EDGE_SE2 7 -3 1 0.1 1.4 10 1 2 20 3 30
"""


def test_a_graph_is_read(tmp_path):
    path = tmp_path / "a.g2o"
    path.write_text(GOOD)
    graph = read_g2o(path)
    np.testing.assert_array_equal(graph.ids, [7, -3])
    np.testing.assert_array_equal(graph.poses, [[0, 0, 0], [1, 0, 1.5]])
    np.testing.assert_array_equal(graph.fixed, [0])
    np.testing.assert_array_equal(graph.edges.i, [0])
    np.testing.assert_array_equal(graph.edges.j, [1])
    np.testing.assert_array_equal(graph.edges.T_i_j, [[1, 0.1, 1.4]])
    assert np.isinf(graph.edges.kernel).all()


def test_chi_squares_are_those_of_the_format(tmp_path):
    truth, edges, start = random_graph(20, 10, seed=2)
    write_g2o(tmp_path / "a.g2o", G2o(np.arange(20), start, edges, np.array([0])))
    rows = [line.split() for line in (tmp_path / "a.g2o").read_text().splitlines()]
    upper = np.array([row[6:] for row in rows if row[0] == "EDGE_SE2"], float)
    error = errors_of(truth, edges)
    for row in range(len(edges.i)):
        T_i_j = between(truth[edges.i[row]], truth[edges.j[row]])
        e = compose(inverse(edges.T_i_j[row]), T_i_j)  # the format's own error
        e[2] = wrap(e[2])
        W = np.zeros((3, 3))
        W[np.triu_indices(3)] = upper[row]
        W += np.triu(W, 1).T
        ours = error[row] @ edges.information[row] @ error[row]
        assert ours == pytest.approx(e @ W @ e)


def test_what_is_written_is_read_back(tmp_path):
    _, edges, start = random_graph(20, 10)
    graph = G2o(np.arange(100, 120), start, edges, np.array([0, 4]))
    write_g2o(tmp_path / "a.g2o", graph)
    again = read_g2o(tmp_path / "a.g2o")
    for one, two in zip(graph[:2] + graph[3:], again[:2] + again[3:], strict=True):
        np.testing.assert_array_equal(one, two)
    np.testing.assert_array_equal(again.edges.T_i_j, edges.T_i_j)
    np.testing.assert_allclose(again.edges.information, edges.information, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("VERTEX_SE2 7 0 0 0", "line 6: vertex 7 occurs twice"),
        ("VERTEX_SE2 8 0 0", "line 6: 2 numbers"),
        ("VERTEX_SE2 8 0 0 nan", "line 6: a number is not finite"),
        ("VERTEX_SE2 x 0 0 0", "line 6: .*'x'"),
        ("VERTEX_SE2 99999999999999999999 0 0 0", "line 6: .*64 bits"),
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1", "line 6: 'VERTEX_SE3:QUAT' is not"),
        ("EDGE_SE2 7 9 0 0 0 1 0 0 1 0 1", "line 6: there is no vertex 9"),
        ("EDGE_SE2 7 7 0 0 0 1 0 0 1 0 1", "line 6: an edge joins vertex 7"),
        ("EDGE_SE2 7", "line 6: "),
        ("FIX 9", "line 6: there is no vertex 9"),
    ],
)
def test_a_bad_line_is_named(tmp_path, line, said):
    path = tmp_path / "a.g2o"
    path.write_text(GOOD + line + "\n")
    with pytest.raises(SourceError, match=said):
        read_g2o(path)


def test_files_without_a_graph_are_named(tmp_path):
    with pytest.raises(SourceError, match="cannot be read"):
        read_g2o(tmp_path / "none.g2o")
    (tmp_path / "a.g2o").write_bytes(b"")
    with pytest.raises(SourceError, match="no VERTEX_SE2"):
        read_g2o(tmp_path / "a.g2o")


WORDS = st.sampled_from(
    ["VERTEX_SE2", "EDGE_SE2", "FIX", "7", "-3", "1e999", "0.5", "\n", "\x00", "é"]
)


@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.one_of(st.binary(max_size=200), st.lists(WORDS, max_size=40).map(" ".join)),
    st.integers(0, 120),
)
def test_anything_is_read_or_named_in_one_line(tmp_path, tail, cut):
    path = tmp_path / "a.g2o"
    tail = tail.encode() if isinstance(tail, str) else tail
    path.write_bytes(GOOD.encode()[:cut] + tail)
    try:
        graph = read_g2o(path)
    except SourceError as error:
        assert str(error).isprintable()  # noqa: PT017
    else:
        assert np.isfinite(graph.poses).all()
        assert len(graph.edges.i) == len(graph.edges.T_i_j)
