"""config.toml: the committed file is the defaults, and every mistake in one is named."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.errors import ConfigError
from stream_dmr.pipeline.config import Config, load_config, parse_config, to_toml

COMMITTED = Path(__file__).resolve().parents[2] / "config.toml"


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "config.toml"
    path.write_text(text, encoding="utf-8")
    return path


def refusal(tmp_path: Path, text: str) -> str:
    with pytest.raises(ConfigError) as caught:
        load_config(write(tmp_path, text))
    message = str(caught.value)
    assert "\n" not in message
    return message.removeprefix(f"{tmp_path}/")


def test_the_committed_file_is_what_the_models_say():
    assert COMMITTED.read_text(encoding="utf-8") == to_toml(Config()), (
        "mend with: python -m stream_dmr.pipeline.config > config.toml"
    )


def test_the_committed_file_gives_the_defaults():
    assert load_config(COMMITTED) == Config() == load_config(None)


def test_a_file_of_a_windows_editor_is_read(tmp_path: Path):
    file = write(tmp_path, "\ufeff[crop_fish]\r\ncrop_size_px = 96\r\n")
    assert load_config(file).crop_fish.crop_size_px == 96


def test_every_knob_has_a_comment():
    for table in Config.model_fields:
        for key, field in type(getattr(Config(), table)).model_fields.items():
            assert field.description, f"[{table}] {key}"
            assert "\n" not in field.description


@given(
    fps=st.floats(0.1, 1e6),
    size=st.integers(32, 1024),
    bending=st.booleans(),
    deformation=st.sampled_from(["spine", "linear-blend"]),
)
def test_changed_settings_survive_the_way_through_toml(
    tmp_path_factory: pytest.TempPathFactory, fps, size, bending, deformation
):
    """The recording keeps the config as TOML, so what is read back must be equal to the bit."""
    tables = {
        "read_frames": {"images_fps": fps},
        "crop_fish": {"crop_size_px": size},
        "localize": {"bending": bending},
        "fit_mesh": {"deformation": deformation},
    }
    config = Config.model_validate(tables)
    path = write(tmp_path_factory.mktemp("config"), to_toml(config))
    assert load_config(path) == config
    assert config.read_frames.images_fps == fps


def test_keys_left_out_keep_their_defaults(tmp_path: Path):
    config = load_config(write(tmp_path, "[smooth_length]\nmin_frames = 1\n"))
    assert config.smooth_length.min_frames == 1
    assert config.fit_mesh == Config().fit_mesh


def test_a_whole_number_is_a_number(tmp_path: Path):
    assert (
        load_config(write(tmp_path, "[read_frames]\nimages_fps = 25")).read_frames.images_fps == 25
    )


MISTAKES = {
    "[fit_mesh]\nsolvr = 'adam'": (" [fit_mesh]: unknown key 'solvr'; did you mean 'solver'?"),
    "[fit_mesh]\nmin_frames = 3": (
        " [fit_mesh]: unknown key 'min_frames'; it belongs to [smooth_length]"
    ),
    "[fit_mush]\nsolver = 'adam'": (" [fit_mush]: unknown table; did you mean [fit_mesh]?"),
    "solver = 'adam'": (": key 'solver' stands outside of any table; it belongs to [fit_mesh]"),
    "fit_mesh = 3": (" [fit_mesh]: expected a table, received 3"),
    "[localize]\nmin_iou = 1.5": (
        " [localize]: 'min_iou' expected a number at least 0 and at most 1, received 1.5"
    ),
    "[localize]\nmin_iou = nan": (
        " [localize]: 'min_iou' expected a number at least 0 and at most 1, received nan"
    ),
    "[hauls]\npause_min = 1e300": (  # which had no nanoseconds
        " [hauls]: 'pause_min' expected a number at least 0 and at most 1e+09, received 1e+300"
    ),
    "[localize]\nmin_iou = 'big'": (
        " [localize]: 'min_iou' expected a number at least 0 and at most 1, "
        'received the string "big"'
    ),
    "[localize]\nbending = 1": (" [localize]: 'bending' expected true or false, received 1"),
    "[smooth_length]\nmin_frames = 2.5": (
        " [smooth_length]: 'min_frames' expected an integer at least 1, received 2.5"
    ),
    "[smooth_length]\nmin_frames = [3]": (
        " [smooth_length]: 'min_frames' expected an integer at least 1, received an array"
    ),
    "[fit_mesh]\ndeformation = 'splines'": (
        ' [fit_mesh]: \'deformation\' expected one of "spine", "linear-blend", '
        'received the string "splines"'
    ),
}


@pytest.mark.parametrize("text", MISTAKES)
def test_every_mistake_is_one_line_with_its_remedy(tmp_path: Path, text: str):
    assert refusal(tmp_path, text) == "config.toml" + MISTAKES[text]


def test_mails_of_older_versions_are_refused_by_name_but_not_in_recordings(tmp_path: Path):
    unused = "[alerts]\nmail_to = ''\nmail_server = 'example.org'\n"
    assert load_config(write(tmp_path, unused)) == Config()
    used = unused.replace("''", "'office@example.org'")
    assert "expected apprise_file, a file with the line mailtos://" in refusal(tmp_path, used)
    assert parse_config(used, where="a recording") == Config()


def test_the_outside_key_names_the_tables_where_none_owns_it(tmp_path: Path):
    assert "the tables are read_frames, detect_fish" in refusal(tmp_path, "speed = 3")


def test_what_is_no_toml_is_refused_with_its_place(tmp_path: Path):
    assert "line 2" in refusal(tmp_path, "[fit_mesh]\nsolver adam")


def test_a_file_of_other_bytes_a_folder_and_a_missing_file_are_refused(tmp_path: Path):
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00")
    for path in (tmp_path / "binary", tmp_path, tmp_path / "none.toml"):
        with pytest.raises(ConfigError, match="expected"):
            load_config(path)


@pytest.mark.parametrize("text", ["two\nlines", "a\ttab", "\x7f", "\x00", 'é"\\'])
def test_any_text_survives_the_way_through_toml(text):
    escaped = "".join(f"\\U{ord(character):08x}" for character in text)
    config = parse_config(f'[fisheries]\nweight_source = "{escaped}"\n', where="x")
    assert config.fisheries.weight_source == text
    assert parse_config(to_toml(config), where="y") == config
