"""Robots' logs with every defect: it is told, and what can be read is kept."""

import itertools
import math
import re
import shutil
import sqlite3
import struct

import cv2
import numpy as np
import pytest
from rosbags.rosbag1 import Reader as Rosbag1Reader
from rosbags.rosbag1 import Writer as Rosbag1Writer

from potlp_jax.errors import LogError
from potlp_jax.images import check_whole
from potlp_jax.learning.dataset import decode, encode
from potlp_jax.logs import writing
from potlp_jax.logs.bag import open_bag
from potlp_jax.logs.collecting import LogCollectConfig, collect_drives
from potlp_jax.logs.drive import PanoramaReader, read_drive
from potlp_jax.logs.inspection import inspect
from potlp_jax.logs.log import SECOND, Log, LogConfig, typestore
from potlp_jax.logs.transforms import quaternion_of
from potlp_jax.logs.writing import BagFormat
from potlp_jax.trials.record import NEVER_SEEN
from tests.reference.tour import (
    CAMERA,
    FORMATS,
    WORLD,
    drive_of,
    first_seen_along,
    name_of,
    panorama_of,
    places_of,
    rewrite,
    step_of,
    tour,
    without,
    write_tour,
)


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    return write_tour(tmp_path_factory.mktemp("bags"))


# Defects, each written into the bag of the tour.


def test_a_bag_without_a_map_names_what_it_has(bags, tmp_path):
    bag = rewrite(bags, tmp_path / "x.bag", without("/map"))
    with pytest.raises(LogError, match=r"x\.bag: has no map: record .*OccupancyGrid.*/odom \(nav_msgs/msg/Odometry\)"):
        drive_of(bag, places_of(bags))
    uses = inspect(Log(bag))["uses"]
    assert all("no map" in use for use in uses.values())


def test_a_bag_without_a_pose_says_what_to_record(bags, tmp_path):
    bag = rewrite(bags, tmp_path / "x.bag", without("/tf", "/odom", "/tf_static"))
    with pytest.raises(LogError, match=r"has no pose: record /tf"):
        drive_of(bag, places_of(bags))
    odometry_alone = rewrite(bags, tmp_path / "y.bag", without("/tf"))
    with pytest.raises(LogError, match=r"nothing says where 'base_link' lies in 'map'.*record /tf"):
        drive_of(odometry_alone, places_of(bags))
    with pytest.raises(LogError, match=r"nothing says where 'lidar' lies in 'map'"):
        drive_of(bags / "tour.bag", places_of(bags), LogConfig(base_frame="lidar"))


def test_odometry_in_the_frame_of_the_map_is_a_pose(bags, tmp_path):
    frame = writing.frame_of(WORLD)

    def localised(topic, message, time):
        if topic == "/odom":
            message.header.frame_id = "map"
            steps = np.cumsum([0.0, *(math.dist(a, b) for a, b in itertools.pairwise(tour()))])
            cell = tour()[int(np.argmin(np.abs(steps - step_of(time))))]
            message.pose.pose.position.x, message.pose.pose.position.y = frame.cell_to_metres(*cell)
        return topic != "/tf"

    drive = drive_of(rewrite(bags, tmp_path / "x.bag", localised), places_of(bags))
    assert drive.path == tuple(tour())


def test_without_pictures_the_baseline_is_replayed_and_no_dataset_made(bags, tmp_path):
    bag = rewrite(bags, tmp_path / "x.bag", without("/panorama/compressed"))
    drive = drive_of(bag, places_of(bags))
    assert [note for note in drive.notes if note.startswith("no picture")]
    assert drive.path == tuple(tour())
    with pytest.raises(LogError, match="no panorama that can be used"):
        collect_drives([drive], places_of(bags), tmp_path / "data", "toy", "training", LogCollectConfig())
    assert inspect(Log(bag))["uses"]["to-dataset"].startswith("no picture")
    assert inspect(Log(bag))["uses"]["replay without pictures (baseline, optimistic, oracle)"] == "yes"


def test_pictures_of_other_encodings_are_lost_and_counted(bags, tmp_path):
    def spoil(topic, message, time):
        if topic == "/panorama/compressed" and message.header.seq // 4 % 2:
            message.format, message.data = "h264", np.arange(200, dtype=np.uint8)

    log = Log(rewrite(bags, tmp_path / "x.bag", spoil))
    spoiled = len(tour()) - len(log.pictures)
    assert 0 < spoiled < len(tour())
    assert f"/panorama/compressed: {spoiled} of {len(tour())} messages are lost: format 'h264' is no JPEG" in str(
        log.problems
    )
    drive = read_drive(log, places_of(bags))
    assert len(drive.pictures) == len(log.pictures)
    reader = PanoramaReader(drive, CAMERA)
    for step in drive.pictures:  # those that are left are the right ones
        assert np.abs(reader.panorama(step).astype(int) - panorama_of(step)).mean() < 4


@pytest.mark.parametrize("encoding", ["png", "jpeg"])
def test_pictures_that_are_cut_off_are_lost_and_counted(bags, tmp_path, encoding):
    def cut(topic, message, time):
        if topic == "/panorama/compressed":
            data = encode(decode(bytes(message.data)), encoding)
            message.data = np.frombuffer(data, np.uint8)[: int(0.6 * len(data))]

    log = Log(rewrite(bags, tmp_path / "x.bag", cut))
    count = len(tour())
    assert log.pictures == []  # though their headers are whole
    assert log.problems == [
        f"/panorama/compressed: {count} of {count} messages are lost: pictures that are cut off or damaged"
    ]
    assert inspect(log)["uses"]["to-dataset"] == "no picture can be read from /panorama/compressed"


@pytest.mark.parametrize("behind", [b"", b"\0" * 1000, b"padding" * 100])
def test_what_cameras_put_behind_a_jpeg_does_not_make_it_cut_off(behind):
    picture = np.random.default_rng(0).integers(0, 255, (40, 80, 3)).astype(np.uint8)
    whole = encode(picture, "jpeg")
    check_whole(whole + behind)
    # A thumbnail is a whole JPEG within one.
    thumbnail = encode(picture[:8, :8], "jpeg")
    with_thumbnail = whole[:2] + b"\xff\xe1" + struct.pack(">H", len(thumbnail) + 2) + thumbnail + whole[2:]
    check_whole(with_thumbnail + behind)
    for cut in (whole, with_thumbnail):
        with pytest.raises(ValueError, match="no end"):
            check_whole(cut[: -len(whole) // 3] + behind)


def test_pictures_of_other_formats_are_read_to_their_end():
    data = cv2.imencode(".webp", np.zeros((40, 80, 3), np.uint8))[1].tobytes()
    check_whole(data)
    with pytest.raises(OSError, match="decoder"):
        check_whole(data[:-4])


def test_a_damaged_picture_takes_no_place_from_a_good_one(bags, tmp_path):
    taken_at = []

    def spoil(topic, message, time):
        """Every second picture is cut off; the one after it is taken in the same cell, farther from its middle."""
        if topic != "/panorama/compressed":
            return
        if len(taken_at) % 2 == 0:
            message.data = message.data[: len(message.data) // 2]
        else:
            moment = taken_at[-1] + SECOND // 10
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(moment, SECOND)
        taken_at.append(time)

    drive = drive_of(rewrite(bags, tmp_path / "x.bag", spoil), places_of(bags))
    assert {step: picture.index for step, picture in drive.pictures.items()} == {
        step: step + 1 for step in range(0, len(tour()) - 1, 2)
    }
    assert PanoramaReader(drive, CAMERA).panorama(4) is not None


def test_messages_of_another_definition_are_lost_and_counted(bags, tmp_path):
    def spoil(topic, message, time):
        return b"\x01\x02" if topic == "/odom" else None

    log = Log(rewrite(bags, tmp_path / "x.bag", spoil))
    count = len(tour())
    assert log.problems == [
        f"/odom: {count} of {count} messages are lost: of another definition than nav_msgs/msg/Odometry"
    ]
    assert read_drive(log, places_of(bags)).path == tuple(tour())


def test_maps_that_make_no_sense_are_lost_and_the_others_kept(bags, tmp_path):
    def spoil(topic, message, time):
        if topic == "/map" and step_of(time) == 0.0:
            message.data = message.data[:-1]
        elif topic == "/map" and step_of(time) < 3.0:
            message.data = np.full_like(message.data, -7)

    log = Log(rewrite(bags, tmp_path / "x.bag", spoil))
    assert any("1 of 21 messages are lost: " in problem and "values for" in problem for problem in log.problems)
    assert any("values from -7 to -7, beyond -1 to 100" in problem for problem in log.problems)
    drive = read_drive(log, places_of(bags))
    assert drive.path[0] == tour()[3]  # a drive begins with the last cell before the first map
    np.testing.assert_array_equal(drive.first_seen != NEVER_SEEN, first_seen_along(WORLD, tour()) != NEVER_SEEN)


def test_thresholds_say_what_is_free_and_what_is_in_between(bags, tmp_path):
    def fade(topic, message, time):
        if topic == "/map":
            message.data = np.where(message.data == 100, 70, np.where(message.data == 0, 40, -1)).astype(np.int8)

    bag = rewrite(bags, tmp_path / "x.bag", fade)
    with pytest.raises(LogError, match=r"leave nothing free in the last map.*40, 70.*--free 50 --occupied 60"):
        drive_of(bag, places_of(bags))
    with pytest.raises(LogError, match=r"leave no obstacle"):
        drive_of(bag, places_of(bags), LogConfig(free=40, occupied=71))
    for config in (LogConfig(free=40, occupied=70), LogConfig(free=69, occupied=70)):
        np.testing.assert_array_equal(
            drive_of(bag, places_of(bags), config).first_seen, first_seen_along(WORLD, tour())
        )
    with pytest.raises(LogError, match="0 <= free < occupied"):
        LogConfig(free=60, occupied=50)


@pytest.mark.parametrize("values", [(40, 70), (0, 10), (80, 100), (26, 64), (99, 100)])
def test_advice_on_thresholds_can_be_followed(bags, tmp_path, values):
    def shift(topic, message, time):
        if topic == "/map":
            message.data = np.where(message.data == 100, values[1], np.where(message.data == 0, values[0], -1))
            message.data = message.data.astype(np.int8)

    bag = rewrite(bags, tmp_path / "x.bag", shift)
    with pytest.raises(LogError, match="the thresholds leave") as told:
        drive_of(bag, places_of(bags))
    advice = re.search(r"--free (\d+) --occupied (\d+)", str(told.value))
    drive = drive_of(bag, places_of(bags), LogConfig(free=int(advice[1]), occupied=int(advice[2])))
    np.testing.assert_array_equal(drive.first_seen, first_seen_along(WORLD, tour()))


def test_no_thresholds_are_advised_where_none_help(bags, tmp_path):
    def flatten(topic, message, time):
        if topic == "/map":
            message.data = np.where(message.data >= 0, 50, -1).astype(np.int8)

    with pytest.raises(LogError, match="it holds the value 50 and unknown cells only; drive further"):
        drive_of(rewrite(bags, tmp_path / "x.bag", flatten), places_of(bags))


def test_gaps_in_the_pose_are_bridged_and_told(bags, tmp_path):
    def lose(topic, message, time):
        return topic == "/tf_static" or topic == "/map" or not 2.0 < step_of(time) < 9.0

    drive = drive_of(rewrite(bags, tmp_path / "x.bag", lose), places_of(bags))
    assert any("pose: 1 gaps of more than 2 s, the longest of" in note for note in drive.notes)
    free = ~np.asarray(WORLD.occupied)
    for before, after in itertools.pairwise(drive.path):
        assert max(abs(before[0] - after[0]), abs(before[1] - after[1])) == 1
        assert free[before[0], after[1]]
        assert free[after[0], before[1]]
    assert drive.path[0] == tour()[0]
    assert drive.path[-1] == tour()[-1]
    log = Log(
        rewrite(bags, tmp_path / "y.bag", lambda topic, _, time: topic != "/odom" or not 2.0 < step_of(time) < 9.0)
    )
    (odometry,) = [topic for topic in inspect(log)["topics"] if topic["name"] == "/odom"]
    (gap,) = odometry["gaps"]
    assert gap["seconds"] == pytest.approx(7.0 * writing.SECONDS_A_CELL, abs=1.0)


def test_pictures_in_a_gap_of_the_pose_are_passed_over(bags, tmp_path):
    def lose(topic, message, time):
        return topic not in ("/tf", "/odom") or not 2.0 < step_of(time) < 18.0

    drive = drive_of(rewrite(bags, tmp_path / "x.bag", lose), places_of(bags), LogConfig(longest_gap=1.0))
    assert any("pictures are passed over: no pose is near" in note for note in drive.notes)


def localised(is_heard):
    """Odometry is whole; localisation is left out where ``is_heard`` of the cells driven is False."""

    def edit(topic, message, time):
        if topic == "/tf" and not is_heard(step_of(time)):
            message.transforms = [each for each in message.transforms if each.child_frame_id == "base_link"]

    return edit


@pytest.mark.parametrize(
    "is_heard", [lambda step: not 8.0 < step < 17.0, lambda step: step < 15.0, lambda step: step > 8.0]
)
def test_a_gap_of_localisation_is_told_though_odometry_goes_on(bags, tmp_path, is_heard):
    drive = drive_of(
        rewrite(bags, tmp_path / "x.bag", localised(is_heard)), places_of(bags), LogConfig(longest_gap=1.0)
    )
    told, over = drive.notes
    assert told.startswith("pose: map -> odom: 1 gaps of more than 1 s, the longest of")
    assert "pictures are passed over: no pose is near" in over
    assert drive.path == tuple(tour())
    moments = np.array([step_of(time) for time in drive.times])
    heard = moments[[is_heard(moment) for moment in moments]]
    distances = np.abs(moments[:, None] - heard).min(axis=1) * writing.SECONDS_A_CELL
    assert sorted(drive.pictures) == np.flatnonzero(distances <= 1.0).tolist()


def test_localisation_that_seldom_speaks_has_no_gap_but_a_note(bags, tmp_path):
    spoken = {step_of(time) for time in Log(bags / "tour.bag").bag.times["/tf"][::5]}
    bag = rewrite(bags, tmp_path / "x.bag", localised(lambda step: step in spoken))
    drive = drive_of(bag, places_of(bags), LogConfig(longest_gap=1.0))
    (told,) = drive.notes
    assert told.startswith("pose: map -> odom: 5 messages at no steady rate, with pauses of up to")
    assert sorted(drive.pictures) == list(range(len(tour())))
    assert drive.path == tuple(tour())


def test_a_gap_of_all_transforms_is_told_once(bags, tmp_path):
    def lose(topic, message, time):
        return topic not in ("/tf", "/odom") or not 8.0 < step_of(time) < 17.0

    notes = drive_of(rewrite(bags, tmp_path / "x.bag", lose), places_of(bags), LogConfig(longest_gap=1.0)).notes
    assert [note[:40] for note in notes if note.startswith("pose")] == ["pose: 1 gaps of more than 1 s, the longe"]


@pytest.mark.parametrize("first", [4.0, 10.0])
def test_pictures_outside_of_the_drive_are_passed_over_and_told(bags, tmp_path, first):
    def late(topic, message, time):
        return step_of(time) >= first if topic == "/panorama/compressed" else step_of(time) < 8.0

    log = Log(rewrite(bags, tmp_path / "x.bag", late))
    drive = read_drive(log, places_of(bags))
    outside = sum(step_of(picture.time) >= 8.0 for picture in log.pictures)
    assert len(drive.pictures) == len(log.pictures) - outside
    told = f"/panorama/compressed: {outside} of {len(log.pictures)} pictures are passed over: before the first cell or"
    assert [note for note in drive.notes if "picture" in note] == [f"{told} after the last pose"]


def test_stamps_of_another_clock_give_way_to_the_recording(bags, tmp_path):
    def shift(topic, message, time):
        if topic == "/panorama/compressed":
            message.header.stamp.sec -= 1_000_000

    drive = drive_of(rewrite(bags, tmp_path / "x.bag", shift), places_of(bags))
    assert any("/panorama/compressed: 21 stamps are by another clock" in note for note in drive.notes)
    assert sorted(drive.pictures) == list(range(len(tour())))


def test_earlier_maps_of_another_resolution_are_laid_on_the_last(bags, tmp_path):
    def refine(topic, message, time):
        if topic == "/map" and step_of(time) < 8.0:
            info = message.info
            cells = message.data.reshape(info.height, info.width)
            message.data = np.kron(cells, np.ones((2, 2), np.int8)).ravel()
            info.resolution, info.height, info.width = info.resolution / 2, 2 * info.height, 2 * info.width

    drive = drive_of(rewrite(bags, tmp_path / "x.bag", refine), places_of(bags))
    np.testing.assert_array_equal(drive.first_seen, first_seen_along(WORLD, tour()))


def test_maps_that_cannot_be_laid_on_each_other_are_refused(bags, tmp_path):
    def turn(topic, message, time):
        if topic == "/map" and step_of(time) < 3.0:
            _, _, z, w = quaternion_of(0.5)
            message.info.origin.orientation.z, message.info.origin.orientation.w = z, w

    with pytest.raises(LogError, match=r"/map: the maps are turned against each other, by 0.5 and 0 radians"):
        drive_of(rewrite(bags, tmp_path / "x.bag", turn), places_of(bags))

    def rename(topic, message, time):
        if topic == "/map" and step_of(time) < 3.0:
            message.header.frame_id = "submap"

    with pytest.raises(LogError, match=r"several frames, 'submap' and 'map'"):
        drive_of(rewrite(bags, tmp_path / "y.bag", rename), places_of(bags))


def test_corrections_of_the_map_are_told(bags, tmp_path):
    def invent(topic, message, time):
        if topic == "/map" and step_of(time) < 2.0:
            message.data = np.where(message.data == 0, 100, message.data).astype(np.int8)

    notes = drive_of(rewrite(bags, tmp_path / "x.bag", invent), places_of(bags)).notes
    assert any("of what a map showed is otherwise in the last one" in note for note in notes)


def test_a_map_that_never_changes_is_told(bags, tmp_path):
    def latch(topic, message, time):
        return topic != "/map" or step_of(time) == step_of(last)

    last = max(Log(bags / "tour.bag").bag.times["/map"])
    whole = rewrite(bags, tmp_path / "x.bag", latch)
    notes = drive_of(whole, places_of(bags)).notes
    assert any("the map is the same all along" in note for note in notes)


def test_topics_are_chosen_by_name_or_asked_for(bags, tmp_path):
    log = Log(bags / "tour.bag", LogConfig(map_topic="/map", image_topic="/panorama/compressed"))
    assert log.problems == []
    with pytest.raises(LogError, match=r"topic /costmap is not in it; topics of type nav_msgs/msg/OccupancyGrid: /map"):
        Log(bags / "tour.bag", LogConfig(map_topic="/costmap"))
    with pytest.raises(LogError, match=r"topic /odom is of type nav_msgs/msg/Odometry"):
        Log(bags / "tour.bag", LogConfig(map_topic="/odom"))
    store = typestore(True)
    with Rosbag1Reader(bags / "tour.bag") as reader, Rosbag1Writer(tmp_path / "x.bag") as writer:
        (source,) = [each for each in reader.connections if each.topic == "/map"]
        for name in ("/local", "/global"):
            copy = writer.add_connection(name, source.msgtype, typestore=store)
            for _, time, data in reader.messages([source]):
                writer.write(copy, time, data)
    with pytest.raises(LogError, match=r"several topics are of type .*: /global, /local; name one with --map-topic"):
        Log(tmp_path / "x.bag")


# Damaged files.


def storage_of(bags, kind):
    return bags / "tour.bag" if kind is BagFormat.ROS1 else next((bags / name_of(kind)).glob("tour*"))


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("share", [0.9, 0.5])
def test_of_a_bag_that_is_cut_short_the_beginning_is_kept(bags, tmp_path, kind, share):
    whole = count_of(bags / name_of(kind))
    copy = tmp_path / name_of(kind)
    (shutil.copy if kind is BagFormat.ROS1 else shutil.copytree)(bags / name_of(kind), copy)
    file = storage_of(tmp_path, kind)
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    log = Log(copy)
    kept = count_of(copy)
    assert 0.3 * whole < kept < whole
    (problem,) = [problem for problem in log.problems if "damaged or cut short" in problem]
    assert f"{kept} messages could be read" in problem
    if kind is BagFormat.ROS1:
        assert "how many are lost is not known" in problem
    else:
        assert f"{whole - kept} of {whole} are lost" in problem
    drive = read_drive(log, places_of(bags))
    # The last map may be smaller than the building, and lie elsewhere on the grid.
    driven = tour()[: len(drive.path)]
    frame = writing.frame_of(WORLD)
    found = np.array([drive.frame.cell_to_metres(*cell) for cell in drive.path])
    np.testing.assert_allclose(found, [frame.cell_to_metres(*cell) for cell in driven], atol=1e-6)
    assert len(drive.path) > 5
    seen = first_seen_along(WORLD, driven)
    assert np.count_nonzero(drive.first_seen != NEVER_SEEN) == np.count_nonzero(seen != NEVER_SEEN)


def count_of(path):
    return sum(len(times) for times in open_bag(path).times.values())


@pytest.mark.parametrize("kind", FORMATS)
def test_a_recording_that_was_killed_is_read(bags, tmp_path, kind):
    copy = tmp_path / name_of(kind)
    if kind is BagFormat.ROS1:  # no index was written
        data = bytearray((bags / "tour.bag").read_bytes())
        place = data.index(b"index_pos=") + len(b"index_pos=")
        data[place : place + 8] = bytes(8)
        copy.write_bytes(data)
    else:
        shutil.copytree(bags / name_of(kind), copy)
        (copy / "metadata.yaml").unlink()
    assert count_of(copy) == count_of(bags / name_of(kind))
    assert drive_of(copy, places_of(bags)).path == tuple(tour())
    if kind is not BagFormat.ROS1:
        assert drive_of(storage_of(tmp_path, kind), places_of(bags)).path == tuple(tour())


def test_blocks_after_a_damaged_one_are_kept(bags, tmp_path):
    bag = rewrite(bags, tmp_path / "x.bag", lambda *_: None, compress=True)
    data = bytearray(bag.read_bytes())
    chunks = [place for place in range(len(data)) if data.startswith(b"compression=none", place)]
    assert len(chunks) > 8
    # A length that leads out of the block, in the middle of the file.
    place = data.index(b"op=\x02", chunks[4])
    data[place - 4 : place] = struct.pack("<L", 2**31)
    bag.write_bytes(data)
    kept, whole = count_of(bag), count_of(bags / "tour.bag")
    assert whole - 20 < kept < whole
    assert f"{whole - kept} of {whole} are lost" in Log(bag).problems[0]


def damaged_page(bags, out, kind):
    """The tour in sqlite, where the middle one of the pages of a kind is damaged."""
    copy = out / name_of(BagFormat.ROS2)
    shutil.copytree(bags / copy.name, copy)
    file = storage_of(out, BagFormat.ROS2)
    with sqlite3.connect(file) as connection:
        (size,) = connection.execute("PRAGMA page_size").fetchone()
    data = bytearray(file.read_bytes())
    pages = [at for at in range(0, len(data), size) if kind(data[at : at + size])]
    place = pages[len(pages) // 2]
    data[place : place + 4] = b"\xff" * 4
    file.write_bytes(data)
    return copy


def leaf(page):
    """Of the table of messages: type 13, several cells."""
    return page[0] == 13 and page[3:5] > b"\0\2"


def overflow(page):
    """What of a message does not fit into the table; it begins with the number of the page on which that goes on."""
    return 0 < int.from_bytes(page[:4], "big") < 2**16


@pytest.mark.parametrize("kind", [leaf, overflow])
def test_rows_around_a_damaged_page_are_kept(bags, tmp_path, kind):
    copy = damaged_page(bags, tmp_path, kind)
    kept, whole = count_of(copy), count_of(bags / copy.name)
    assert whole / 2 < kept < whole
    assert f"{whole - kept} of {whole} are lost" in Log(copy).problems[0]


@pytest.mark.parametrize("kind", [leaf, overflow])
def test_rows_behind_a_damaged_page_stay_in_the_order_of_time(bags, tmp_path, kind):
    copy = damaged_page(bags, tmp_path, kind)
    log = Log(copy)
    moments = [message.time for message in log.bag.messages(log.bag.topics)]
    assert moments == sorted(moments)
    # What a map that is left shows is known from its time on, and not from the end of the drive.
    drive, maps = read_drive(log, places_of(bags)), {message.time for message in log.read_maps()}
    times = Log(bags / "tour.bag").bag.times["/map"]
    steps = np.array([step for step, time in enumerate(times) if time in maps])
    assert len(tour()) // 2 < len(steps)
    seen = first_seen_along(WORLD, tour())
    late = np.append(steps, NEVER_SEEN)[np.searchsorted(steps, np.where(seen == NEVER_SEEN, steps[-1] + 1, seen))]
    path = set(drive.path)
    for cell in np.argwhere(late != NEVER_SEEN):
        if tuple(cell.tolist()) not in path:
            assert drive.times[drive.first_seen[tuple(cell)]] == times[late[tuple(cell)]]


def test_files_of_a_recording_that_was_killed_are_read_by_their_numbers(bags, tmp_path):
    whole = Log(bags / name_of(BagFormat.ROS2)).bag.times["/map"]
    ends = [0, whole[7], whole[14], whole[-1] + 1]
    for number, since, until in zip((1, 2, 10), ends, ends[1:], strict=False):
        file = tmp_path / f"tour_{number}.db3"
        shutil.copy(storage_of(bags, BagFormat.ROS2), file)
        with sqlite3.connect(file) as connection:
            connection.execute("DELETE FROM messages WHERE timestamp < ? OR timestamp >= ?", (since, until))
    assert open_bag(tmp_path).times["/map"] == whole


def test_what_is_no_bag_is_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "empty.bag").write_bytes(b"")
    (tmp_path / "other.mcap").write_bytes(b"hello, this is no MCAP file at all, but something else")
    (tmp_path / "folder").mkdir()
    for name, message in {
        "missing.bag": "there is no such file",
        "notes.txt": ".txt is no format of logs",
        "empty.bag": "is no ROS 1 bag",
        "other.mcap": "is no MCAP file",
        "folder": "is no ROS 2 bag",
    }.items():
        with pytest.raises(LogError, match=message):
            open_bag(tmp_path / name)
    with Rosbag1Writer(tmp_path / "silent.bag") as writer:
        writer.add_connection("/map", "nav_msgs/msg/OccupancyGrid", typestore=typestore(True))
    with pytest.raises(LogError, match="holds no message"):
        open_bag(tmp_path / "silent.bag")
