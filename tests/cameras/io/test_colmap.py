from torchrefract.cameras.io.colmap import read_colmap, write_colmap

# The layout of COLMAP's documentation; parameters in the order of its camera models.
TEXT = """# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
# Number of cameras: 9
1 SIMPLE_PINHOLE 3072 2304 2559.81 1536 1152
2 PINHOLE 3072 2304 2560.56 2559.69 1536 1152
3 SIMPLE_RADIAL 3072 2304 2559.69 1536 1152 -0.0218531
4 RADIAL 640 480 500 320 240 -0.1 0.02
5 OPENCV 640 480 500 505 320 240 -0.1 0.02 0.001 -0.002
6 FULL_OPENCV 640 480 500 505 320 240 0.6 0.12 0.001 -0.0005 0.01 0.95 0.25 0.03
7 OPENCV_FISHEYE 640 480 300 305 320 240 -0.01 0.05 -0.04 0.01
8 SIMPLE_RADIAL_FISHEYE 640 480 300 320 240 -0.01
9 RADIAL_FISHEYE 640 480 300 320 240 -0.01 0.05
"""
LENSES = {
    1: ("opencv", 2559.81, 2559.81, (0.0, 0.0, 0.0, 0.0)),
    2: ("opencv", 2560.56, 2559.69, (0.0, 0.0, 0.0, 0.0)),
    3: ("opencv", 2559.69, 2559.69, (-0.0218531, 0.0, 0.0, 0.0)),
    4: ("opencv", 500.0, 500.0, (-0.1, 0.02, 0.0, 0.0)),
    5: ("opencv", 500.0, 505.0, (-0.1, 0.02, 0.001, -0.002)),
    6: ("opencv", 500.0, 505.0, (0.6, 0.12, 0.001, -0.0005, 0.01, 0.95, 0.25, 0.03)),
    7: ("fisheye", 300.0, 305.0, (-0.01, 0.05, -0.04, 0.01)),
    8: ("fisheye", 300.0, 300.0, (-0.01, 0.0, 0.0, 0.0)),
    9: ("fisheye", 300.0, 300.0, (-0.01, 0.05, 0.0, 0.0)),
}


def test_colmap_cameras_are_read_with_centers_half_a_pixel_lower(tmp_path):
    path = tmp_path / "cameras.txt"
    path.write_text(TEXT)
    cameras = read_colmap(path)
    for number, expected in LENSES.items():
        camera = cameras[number]
        assert (camera.model, camera.fx, camera.fy, camera.coefficients) == expected
        # COLMAP's (W / 2, H / 2) is the middle of the frame; so is ((W - 1) / 2, (H - 1) / 2) here.
        assert (camera.cx, camera.cy) == ((camera.width - 1) / 2, (camera.height - 1) / 2)


def test_written_files_have_the_layout_of_colmap_and_are_read_back(tmp_path, make_camera):
    path = tmp_path / "cameras.txt"
    cameras = {
        1: make_camera((0.0, 0.0, 0.0, 0.0)),
        2: make_camera((-0.3, 0.1, 0.002, 1 / 3)),
        5: make_camera((0.6, 0.12, 1e-3, -5e-4, 0.01, 0.95, 0.25, 0.03)),
        7: make_camera((-0.01, 0.05, -0.04, 0.01), "fisheye"),
    }
    write_colmap(path, cameras)
    assert read_colmap(path) == cameras
    lines = [line.split() for line in path.read_text().splitlines() if not line.startswith("#")]
    assert [line[1] for line in lines] == ["PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"]
    assert [len(line) for line in lines] == [8, 12, 16, 12]
    assert [line[2:8] for line in lines] == [["640", "480", "510.25", "505.75", "323.0", "237.625"]] * 4
    write_colmap(path, {1: make_camera((-0.3, 0.1, 0.002, 0.0, 0.01))})
    assert read_colmap(path)[1] == make_camera((-0.3, 0.1, 0.002, 0.0, 0.01, 0.0, 0.0, 0.0))
