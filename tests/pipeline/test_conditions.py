"""--pose lying and --stills as settings: what the user has set comes first."""

from collections.abc import Callable
from functools import partial

import pytest

from stream_dmr.pipeline.config import Config, as_calibrated, lying, parse_config
from stream_dmr.pipeline.config import stills as stills_of

stills = partial(stills_of, is_calibrated=True)


@pytest.mark.parametrize("condition", [lying, stills])
def test_a_condition_changes_settings_once(condition: Callable[[Config], Config]):
    changed = condition(Config())
    assert changed != Config()
    assert condition(changed) == changed


def test_lying_fish_rest_on_the_plane_and_hardly_tilt():
    config = lying(Config())
    assert config.localize.rests_on_plane
    assert config.fit_mesh.hang == "plane"
    assert config.fit_mesh.tilt_std_rad < Config().fit_mesh.tilt_std_rad
    assert config.fit_mesh.arch_std_rad < 0.2 * config.fit_mesh.bend_std_rad
    assert config.smooth_length.upward_share == 0.5
    assert config.localize.max_slant_rad > Config().localize.max_slant_rad  # decks seen from aside


def test_one_good_still_gives_a_length():
    config = stills(Config())
    assert config.smooth_length.min_frames == 1
    assert config.localize == Config().localize


def test_the_users_own_settings_stay():
    own = parse_config(
        "[fit_mesh]\ntilt_std_rad = 0.4\n[smooth_length]\nmin_frames = 5\n", where="own"
    )
    assert lying(own).fit_mesh.tilt_std_rad == 0.4
    assert lying(own).fit_mesh.bend_std_rad == lying(Config()).fit_mesh.bend_std_rad
    assert stills(own).smooth_length.min_frames == 5


def test_both_conditions_hold_together_in_either_order():
    assert lying(stills(Config())) == stills(lying(Config()))


def test_with_a_calibration_pictures_are_as_the_sensor_saw_them():
    assert as_calibrated(Config()).read_frames.orientation == "sensor"
    own = parse_config('[read_frames]\norientation = "upright"', where="own")
    assert as_calibrated(own).read_frames.orientation == "upright"


def test_a_calibration_holds_for_pictures_of_one_size():
    assert stills(Config()).read_frames.other_sizes == "leave_out"
    assert stills_of(Config(), is_calibrated=False).read_frames.other_sizes == "take"
