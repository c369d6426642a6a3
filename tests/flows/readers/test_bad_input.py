"""Bad scenes, and the sentence that the user sees for each."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch

from flows.errors import InputError
from flows.readers import Capture, read_capture
from flows.readers.matching import Finder

CASES = {}


def case(message: str, **keys):
    """Register a function that damages (or builds) a scene in a folder; `message` is what must be said."""

    def register(build):
        CASES[build.__name__] = (build, message, keys)
        return build

    return register


def _transforms(folder: Path, **changes) -> dict:
    content = json.loads((folder / "transforms.json").read_text()) | changes
    (folder / "transforms.json").write_text(json.dumps(content))
    return content


def _frame(folder: Path, index: int = 1, **changes) -> None:
    content = json.loads((folder / "transforms.json").read_text())
    content["frames"][index] |= changes
    (folder / "transforms.json").write_text(json.dumps(content))


def _matrix(change) -> list:
    matrix = np.eye(4)
    change(matrix)
    return matrix.tolist()


@pytest.fixture
def scene(tmp_path, write_images) -> Path:
    """A good transforms.json scene of five frames."""
    names = write_images(tmp_path / "scene" / "images", 5)
    frames = [
        {"file_path": f"images/{n}", "transform_matrix": _matrix(lambda m, i=i: m.__setitem__((0, 3), i))}
        for i, n in enumerate(names)
    ]
    content = {"w": 64, "h": 48, "fl_x": 70, "fl_y": 70, "cx": 32, "cy": 24, "frames": frames}
    (tmp_path / "scene" / "transforms.json").write_text(json.dumps(content))
    return tmp_path / "scene"


@case("does not exist; give the folder of a scene")
def folder_missing(scene):
    return scene / "nowhere"


@case("is not a scene that a reader recognises. Looked for:")
def folder_empty(scene):
    (scene / "empty").mkdir()
    return scene / "empty"


@case("has a NaN or infinite number in its pose")
def pose_nan(scene):
    _frame(scene, transform_matrix=_matrix(lambda m: m.__setitem__((0, 3), math.nan)))


@case("images/001.png has a pose whose 3x3 part is not a rotation")
def pose_scaled(scene):
    _frame(scene, transform_matrix=(2 * np.eye(4)).tolist())


@case("mirrored pose")
def pose_mirrored(scene):
    _frame(scene, transform_matrix=np.diag([-1.0, 1, 1, 1]).tolist())


@case("has the shape (2, 2); expected (4, 4)")
def pose_of_wrong_shape(scene):
    _frame(scene, transform_matrix=[[1, 0], [0, 1]])


@case("is not made of numbers only")
def pose_of_words(scene):
    _frame(scene, transform_matrix=[["a", 0, 0, 0]] * 4)


@case('has no "transform_matrix"')
def pose_absent(scene):
    content = json.loads((scene / "transforms.json").read_text())
    del content["frames"][2]["transform_matrix"]
    (scene / "transforms.json").write_text(json.dumps(content))


@case("has a focal length of 0 x 70 pixels; both must be positive")
def focal_zero(scene):
    _transforms(scene, fl_x=0)


@case("neither fl_x nor camera_angle_x; add the focal length")
def focal_absent(scene):
    content = _transforms(scene)
    del content["fl_x"], content["fl_y"]
    (scene / "transforms.json").write_text(json.dumps(content))


@case("\"fl_x\" of images/000.png is '70'; expected a number")
def focal_a_string(scene):
    _transforms(scene, fl_x="70")


@case("camera_angle_x is 4; expected radians between 0 and pi")
def angle_impossible(scene):
    content = _transforms(scene, camera_angle_x=4)
    del content["fl_x"], content["fl_y"]
    (scene / "transforms.json").write_text(json.dumps(content))


@case("lists images/001.png more than once")
def names_twice(scene):
    _frame(scene, 2, file_path="images/001.png")


@case('names the file "/etc/passwd", which is outside the scene\'s folder')
def path_absolute(scene):
    _frame(scene, file_path="/etc/passwd")


@case("use a path relative to the folder and without .. in it")
def path_with_dots(scene):
    _frame(scene, file_path="images/../../other/001.png")


@case("which a symbolic link leads out of")
def path_through_a_symlink(scene):
    outside = scene.parent / "outside.png"
    (scene / "images" / "001.png").rename(outside)
    (scene / "images" / "001.png").symlink_to(outside)


@case('frame 1 has no "file_path"')
def path_null(scene):
    _frame(scene, file_path=None)


@case("is not valid JSON: Expecting ',' delimiter at line 3, column 1")
def json_syntax(scene):
    (scene / "transforms.json").write_text('{\n"w": 3\n"h": 4}')


@case("is not a text file in UTF-8")
def json_binary(scene):
    (scene / "transforms.json").write_bytes(b"\xff\xfe\x00\x01" * 20)


@case('has no list "frames"')
def frames_absent(scene):
    (scene / "transforms.json").write_text("[1, 2]")


@case("lists 5 frames, but none of their images exists (first: images/000.png)")
def images_absent(scene):
    for file in (scene / "images").iterdir():
        file.unlink()


@case('the camera model "EQUIRECTANGULAR", which is not supported')
def model_unknown(scene):
    _transforms(scene, camera_model="EQUIRECTANGULAR")


@case('the camera model "ftheta_p0", which is not supported')
def ftheta_lens(scene):
    _transforms(scene, ftheta_p0=0.1)


@case("camera model FISHEYE with k5 other than 0 is not supported")
def fisheye_of_too_high_order(scene):
    _transforms(scene, camera_model="FISHEYE", k5=0.1)


@case("another aspect ratio")
def image_of_another_shape(scene):
    _transforms(scene, w=48, h=64)


@case("applied_transform cannot be inverted")
def applied_transform_singular(scene):
    _transforms(scene, applied_transform=np.zeros((3, 4)).tolist())


@case("001.png is empty (0 bytes)")
def image_zero_bytes(scene):
    (scene / "images" / "001.png").write_bytes(b"")


@case("train id 5 is out of range; transforms.json lists 5 frames (ids 0 to 4)")
def split_out_of_range(scene):
    (scene / "train_test_split_3.json").write_text('{"train_ids": [0, 1, 5], "test_ids": [2]}')


@case("has view 1 both for training and for testing")
def split_overlap(scene):
    (scene / "train_test_split_3.json").write_text('{"train_ids": [0, 1], "test_ids": [1]}')


@case('has no list of whole numbers "test_ids"')
def split_without_tests(scene):
    (scene / "train_test_split_3.json").write_text('{"train_ids": [0, 1.5]}'.replace("1.5", "1"))


@case("has no training view")
def split_without_training(scene):
    (scene / "train_test_split_3.json").write_text('{"train_ids": [], "test_ids": [1]}')


@case("lists a train view twice")
def split_twice(scene):
    (scene / "train_test_split_3.json").write_text('{"train_ids": [0, 0], "test_ids": [1]}')


@case("has no train_test_split_N.json", reader="reconfusion")
def reader_of_another_layout(scene):
    pass


@case("View counts must be positive numbers", view_counts=(3, 0))
def view_count_zero(scene):
    pass


@case("holds no images; put the photos there", reader="photos")
def photos_absent(scene):
    (scene / "none").mkdir()
    return scene / "none"


@case("is a symbolic link out of", reader="photos")
def photos_symlink(scene):
    (scene / "images" / "000.png").rename(scene.parent / "out.png")
    (scene / "images" / "000.png").symlink_to(scene.parent / "out.png")
    return scene / "images"


@case("IMG_0001.HEIC is ", reader="photos")
def photos_heic(scene):
    (scene / "images" / "IMG_0001.HEIC").write_bytes(b"ftypheic")
    return scene / "images"


def _llff(scene: Path, rows: np.ndarray, **keys) -> None:
    np.save(scene / "poses_bounds.npy", rows, **keys)
    (scene / "transforms.json").unlink()


@case("has 7 rows, but")
def llff_row_count(scene):
    for file, name in zip(sorted((scene / "images").iterdir()), "abcde", strict=True):
        file.rename(file.with_name(f"{name}.png"))
    _llff(scene, np.ones((7, 17)))


@case("nothing tells which row is whose")
def llff_rows_that_may_start_anywhere(scene):
    (scene / "images" / "000.png").unlink()
    _llff(scene, np.ones((7, 17)))


@case("has the shape (5, 15); expected N x 17 numbers")
def llff_shape(scene):
    _llff(scene, np.ones((5, 15)))


@case("cannot be read as a plain NumPy array")
def llff_pickle(scene):
    _llff(scene, np.array([{"a": 1}], dtype=object), allow_pickle=True)


@case("an image size of 0 x 0 pixels")
def llff_zero_size(scene):
    _llff(scene, np.zeros((5, 17)))


def _model(scene: Path, model: str = "SIMPLE_RADIAL", params=(70, 32, 24, 0.1)) -> Path:
    (scene / "transforms.json").unlink()
    reconstruction = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model=model, width=64, height=48, params=list(params), camera_id=1)
    reconstruction.add_camera_with_trivial_rig(camera)
    for i in range(5):
        image = pycolmap.Image(name=f"00{i}.png", camera_id=1, image_id=i + 1)
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.eye(4)[:3]))
    folder = scene / "sparse" / "0"
    folder.mkdir(parents=True)
    reconstruction.write_binary(str(folder))
    return folder


@case("images.bin is cut short")
def colmap_truncated(scene):
    file = _model(scene) / "images.bin"
    file.write_bytes(file.read_bytes()[:60])


@case("cannot be read")
def colmap_garbage(scene):
    folder = _model(scene)
    (folder / "cameras.bin").write_bytes((1).to_bytes(8, "little") + b"\xff" * 80)


@case("has no images.bin; copy the whole model")
def colmap_file_absent(scene):
    (_model(scene) / "images.bin").unlink()


@case("camera model FOV is not supported")
def colmap_field_of_view_lens(scene):
    _model(scene, "FOV", (70, 70, 32, 24, 0.5))


@case("None of the 5 images of the COLMAP model")
def colmap_images_absent(scene):
    _model(scene)
    for file in (scene / "images").iterdir():
        file.rename(file.with_name(f"x{file.name}"))


@case("cannot be read (", reader="colmap")
def colmap_unknown_model_in_text(scene):
    folder = scene / "sparse"
    folder.mkdir()
    (folder / "cameras.txt").write_text("1 NO_SUCH_MODEL 64 48 70 32 24\n")
    (folder / "images.txt").write_text("1 1 0 0 0 0 0 0 1 000.png\n\n")
    (folder / "points3D.txt").write_text("")


@case('has no array "world_mat_0"; it has: other')
def dtu_key_absent(scene):
    (scene / "transforms.json").unlink()
    np.savez(scene / "cameras_sphere.npz", other=np.eye(4))
    (scene / "images").rename(scene / "image")


@case("is NaN or singular")
def dtu_singular(scene):
    (scene / "transforms.json").unlink()
    np.savez(scene / "cameras_sphere.npz", **{f"world_mat_{i}": np.zeros((4, 4)) for i in range(5)})
    (scene / "images").rename(scene / "image")


@case("cannot be read as a NumPy archive of plain arrays")
def co3d_pickle(scene):
    (scene / "transforms.json").unlink()
    np.savez(scene / "gt_cameras.npz", gtR=np.array([{}], dtype=object), gtT=np.zeros(3), gtFL=np.zeros(2))


@case("has 4 cameras (gtR) for the 5 images")
def co3d_count(scene):
    (scene / "transforms.json").unlink()
    np.savez(scene / "gt_cameras.npz", gtR=np.zeros((4, 3, 3)), gtT=np.zeros((4, 3)), gtFL=np.zeros((4, 2)))


@case("line 3: expected 19 numbers, got 4")
def realestate_short_line(scene):
    (scene / "transforms.json").unlink()
    good = " ".join(["5"] + ["1"] * 18)
    (scene / "clip.txt").write_text(f"https://x\n{good}\n1 2 3 4\n")


@case("is the name of an image in")
def realestate_no_frame(scene):
    (scene / "transforms.json").unlink()
    (scene / "clip.txt").write_text("https://x\n" + " ".join(["999"] + ["1"] * 18))


@case("line 2: expected numbers, got 'hello'")
def strecha_words(scene):
    (scene / "transforms.json").unlink()
    (scene / "000.png.camera").write_text("1 0 0\nhello\n")


@case("does not have the 9 rows of a Strecha camera")
def strecha_short(scene):
    (scene / "transforms.json").unlink()
    (scene / "000.png.camera").write_text("1 0 0\n")


@case("There is no scene family 'castle'")
def procedural_family(scene):
    return "procedural:castle/1"


@case("is not of the form procedural:FAMILY/SEED")
def procedural_form(scene):
    return "procedural:llff"


@case("views must be a whole number from 1 to 1000")
def procedural_views(scene):
    return "procedural:llff/1?views=many"


@pytest.mark.parametrize("name", CASES)
def test_the_user_sees_this_sentence(name, scene):
    build, message, keys = CASES[name]
    path = build(scene) or scene
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        read_capture(path, **keys)
    assert "Traceback" not in str(caught.value)


def test_there_are_at_least_25_cases_and_a_good_scene_passes(scene):
    assert len(CASES) >= 25
    assert len(read_capture(scene)) == 5


@pytest.mark.parametrize("name", ["", "/x", "../x", "a/../../x", "C:\\x", "..\\x", "a\0b"])
def test_inside_refuses_paths_that_leave(tmp_path, name):
    with pytest.raises(InputError):
        Finder(tmp_path, "test").find(name)


def test_inside_allows_dots_in_names_and_links_within(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").symlink_to(tmp_path / "a")
    (tmp_path / "a" / "x..y.png").touch()
    assert Finder(tmp_path, "test").find("b/x..y.png") == tmp_path / "b" / "x..y.png"


def test_capture_validate_names_lengths_and_ids(scene):
    good = read_capture(scene)
    with pytest.raises(InputError, match="has 5 names but 4 cameras"):
        replace(good, cameras=good.cameras[:4]).validate()
    with pytest.raises(InputError, match="test id -1 is out of range"):
        replace(good, splits={"3": {"train": [0], "test": [-1]}}).validate()
    with pytest.raises(InputError, match="NaN or infinite number in its depth bounds"):
        replace(good, depth_bounds=torch.full((5, 2), math.nan)).validate()
    with pytest.raises(InputError, match="has no images"):
        Capture("x", "photos", []).validate()
