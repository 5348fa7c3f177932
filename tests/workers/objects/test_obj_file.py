"""The OBJ reader against meshes written from known arrays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.schemas.errors import InputError
from datagen.workers.objects import obj_file
from datagen.workers.objects.obj_file import read_obj


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_written_meshes_are_read(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    """Any mixture of corner styles, polygons, negative indices, groups and comments."""
    path = tmp_path_factory.mktemp("obj") / "mesh.obj"
    number = st.floats(-1, 1, allow_nan=False).map(lambda x: round(x, 6))
    vertices = data.draw(st.lists(st.tuples(number, number, number), min_size=3, max_size=12))
    uv = data.draw(st.lists(st.tuples(number, number), min_size=1, max_size=6))
    lines = [f"v {x} {y} {z}" for x, y, z in vertices] + [f"vt {u} {v}" for u, v in uv]
    lines.insert(data.draw(st.integers(0, len(lines))), "# a comment")
    expected: list[tuple[int, int, int]] = []
    expected_uv: list[tuple[int, int, int]] = []
    groups: list[int] = []
    for _ in range(data.draw(st.integers(1, 8))):
        if data.draw(st.booleans()):
            lines.append("o part")
            groups.append(len(expected))
        style = data.draw(st.sampled_from(["v", "v/t", "v//n", "v/t/n"]))
        count = data.draw(st.integers(3, 5))
        v = data.draw(st.lists(st.integers(0, len(vertices) - 1), min_size=count, max_size=count))
        t = data.draw(st.lists(st.integers(0, len(uv) - 1), min_size=count, max_size=count))
        negative = data.draw(st.booleans())
        corners: list[str] = []
        for a, b in zip(v, t, strict=True):
            va, tb = (a - len(vertices), b - len(uv)) if negative else (a + 1, b + 1)
            corners.append(style.replace("v", str(va)).replace("t", str(tb)).replace("n", "7"))
        lines.append(data.draw(st.sampled_from(["f ", "f  ", " f "])) + "  ".join(corners))
        for k in range(1, count - 1):
            expected.append((v[0], v[k], v[k + 1]))
            expected_uv.append((t[0], t[k], t[k + 1]) if "t" in style else (-1, -1, -1))
    end = data.draw(st.sampled_from(["\n", "\r\n", "\r"]))
    if data.draw(st.booleans()):
        lines = [line.replace(" ", data.draw(st.sampled_from(["\t", f" \\{end} "]))) for line in lines]
    path.write_bytes((end.join(lines) + data.draw(st.sampled_from(["", end]))).encode())
    mesh = read_obj(path)
    np.testing.assert_array_equal(mesh.faces, expected)
    np.testing.assert_array_equal(mesh.uv_faces, expected_uv)
    np.testing.assert_allclose(mesh.vertices, vertices)
    np.testing.assert_allclose(mesh.uv, uv)
    assert mesh.group_starts.tolist() == groups
    assert mesh.materials == ()
    assert sum(len(g) for g in mesh.group_faces()) == len(expected)


@settings(max_examples=80, deadline=None)
@given(
    text=st.one_of(
        st.binary(max_size=200), st.text("vftog 0123456789/-.nane\t\n\\", max_size=200).map(str.encode)
    )
)
def test_any_bytes_are_read_or_refused_in_one_line(
    tmp_path_factory: pytest.TempPathFactory, text: bytes
) -> None:
    path = tmp_path_factory.mktemp("obj") / "mesh.obj"
    path.write_bytes(b"v 0 0 0\nv 1 0 0\nv 0 1 0\n" + text)
    try:
        mesh = read_obj(path)
    except InputError as error:
        assert str(path) in str(error) and "\n" not in str(error)
    else:
        assert mesh.faces.min() >= 0 and mesh.faces.max() < len(mesh.vertices)
        assert np.isfinite(mesh.vertices).all()


@pytest.mark.parametrize("block_bytes", [7, 100, 2**16])
def test_plain_lines_and_others_are_read_to_the_last_bit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block_bytes: int
) -> None:
    """Wherever the file is cut into blocks; a second space is enough for the slow reader."""
    rng = np.random.default_rng(0)
    vertices = rng.uniform(-1, 1, (400, 3)) * 10.0 ** rng.integers(-12, 12, (400, 1))
    faces = rng.integers(1, 401, (300, 6))
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    lines += [f"vt {x!r} {y!r}" for x, y, _ in vertices.tolist()]
    lines += ["f {}/{} {}/{} {}/{}".format(*face) for face in faces.tolist()]
    others = [line.replace(" ", "  ", 1) if k % 7 < 3 else line for k, line in enumerate(lines)]
    monkeypatch.setattr(obj_file, "_BLOCK_BYTES", block_bytes)
    for written in (lines, others):
        (tmp_path / "mesh.obj").write_text("\n".join(written))
        mesh = read_obj(tmp_path / "mesh.obj")
        assert mesh.vertices.tobytes() == vertices.tobytes()
        assert mesh.uv.tobytes() == np.ascontiguousarray(vertices[:, :2]).tobytes()
        np.testing.assert_array_equal(mesh.faces, faces[:, ::2] - 1)
        np.testing.assert_array_equal(mesh.uv_faces, faces[:, 1::2] - 1)


HEAD = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\n"
BAD = {
    "no faces": (HEAD, "no faces"),
    "NaN": ("v 0 nan 0\nf 1 1 1\n", "line 1"),
    "words for numbers": (HEAD + "v a b c\nf 1 2 3\n", "line 5"),
    "two corners": (HEAD + "f 1 2\n", "line 5"),
    "index 0": (HEAD + "f 0 1 2\n", "line 5"),
    "index too large": (HEAD + "f 1 2 3\nf 1 2 4\n", "face 2"),
    "texture index too large": (HEAD + "f 1/1 2/1 3/2\n", "face 1"),
    "mixed corners": (HEAD + "f 1/1 2 3/1\n", "line 5"),
    "huge index": (HEAD + "f 1 2 99999999999999999999999\n", "line 5"),
    "texture NaN": (HEAD + "vt nan 0\nf 1/1 2/1 3/1\n", "line 5"),
    "binary": ("\x00\x01\x02" * 50, "is a binary file"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_meshes_name_the_line(case: str, tmp_path: Path) -> None:
    text, where = BAD[case]
    path = tmp_path / "mesh.obj"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_obj(path)
    assert where in str(caught.value) and str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_limits_stop_the_reading(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "mesh.obj"
    path.write_text(HEAD + "f 1 2 3\n" * 1000)
    monkeypatch.setattr(obj_file, "MAX_LINE_BYTES", 100)
    assert len(read_obj(path).faces) == 1000
    monkeypatch.setattr(obj_file, "MAX_FACES", 999)
    with pytest.raises(InputError, match="more than 999 faces"):
        read_obj(path)
    fans = tmp_path / "fans.obj"
    fans.write_text(HEAD + "f 1 2 3 1 2 3\n" * 300)
    with pytest.raises(InputError, match="more than 999 faces"):
        read_obj(fans)
    monkeypatch.setattr(obj_file, "MAX_FILE_BYTES", 1000)
    with pytest.raises(InputError, match="bytes"):
        read_obj(path)
    path.write_text("x" * 300)
    with pytest.raises(InputError, match="too long"):
        read_obj(path)
    monkeypatch.undo()
    for missing in (tmp_path / "none.obj", tmp_path):
        with pytest.raises(InputError, match=r"cannot be read|is not a file"):
            read_obj(missing)


@pytest.mark.parametrize("block_bytes", [1, 7, 64, 2**16])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_lines_are_numbered_and_joined_wherever_the_file_is_cut(
    end: str, block_bytes: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lines = ["# ends in \\", "v 0 0 0", "v 1 \\", "0 \\", "0", "v\t0 1 0", "", "f 1 2 3", "f 1 2 9x"]
    monkeypatch.setattr(obj_file, "_BLOCK_BYTES", block_bytes)
    path = tmp_path / "mesh.obj"
    path.write_bytes(end.join(lines[:-1]).encode())
    mesh = read_obj(path)
    np.testing.assert_array_equal(mesh.vertices, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2]])
    path.write_bytes(end.join(lines).encode())
    with pytest.raises(InputError, match=r"line 9: .*: 'f 1 2 9x'"):
        read_obj(path)


def test_the_materials_are_those_of_faces(tmp_path: Path) -> None:
    path = tmp_path / "mesh.obj"
    path.write_text(
        "mtllib a.mtl\nmtllib b.mtl\nusemtl none\n"
        + HEAD
        + "usemtl\tone two\nf 1 2 3\nusemtl last\nf 1 2 3\n"
    )
    mesh = read_obj(path)
    assert (mesh.material_library, mesh.materials) == ("a.mtl", ("one two", "last"))
    path.write_text(HEAD + "f 1 2 3\nusemtl late\n")
    assert read_obj(path).materials == ()
