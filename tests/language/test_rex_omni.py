import sys
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from mjx_grasp.errors import FileError, InputError
from mjx_grasp.language.camera import PinholeCamera
from mjx_grasp.language.grounding import GroundingError, Target, View
from mjx_grasp.language.rex_omni import RexOmniConfig, RexOmniGrounder, build_prompt, parse_points


def answer(*contents, phrase="handle of the mug"):
    return ", ".join(
        f"<|object_ref_start|>{phrase}<|object_ref_end|><|box_start|>{c}<|box_end|>"
        for c in contents
    )


@pytest.mark.parametrize(
    ("instruction", "name", "prompt"),
    [
        ("by the handle", "025_mug", "Point to handle of the mug."),
        ("Pick up the mug by the handle, please!", "mug", "Point to handle of the mug."),
        ("grasp the top", "sugar_box", "Point to top of the sugar box."),
        ("the red mug", "mug", "Point to red mug."),
        ("wing", "072-a_toy_airplane", "Point to wing of the toy airplane."),
        ("left, not right", "", "Point to left not right."),
        ("grab it on the rim", "024_bowl", "Point to rim of the bowl."),
    ],
)
def test_prompts(instruction, name, prompt):
    assert build_prompt(instruction, name) == prompt


def test_an_instruction_without_a_place_is_refused():
    for instruction in ("", "  ", "?!"):
        with pytest.raises(GroundingError, match="no place"):
            build_prompt(instruction, "mug")


@pytest.mark.parametrize(
    ("text", "points"),
    [
        (answer("<0><0>"), [(0, 0)]),
        (answer("<999><999>") + "<|im_end|>", [(640, 480)]),
        (answer("<500><250>") + "<|im_end|>\n", [(320.32, 120.12)]),
        (answer("<100><200>,<300><400>"), [(64.06, 96.1), (192.19, 192.19)]),
        (answer("<100><200>, <300><400>"), [(64.06, 96.1), (192.19, 192.19)]),
        (answer("<100><200>", "<300><400>"), [(64.06, 96.1), (192.19, 192.19)]),
        (answer("None", "<300><400>"), [(192.19, 192.19)]),
        ("\n" + answer(" <7> <8> ", phrase=" red\nrim "), [(4.48, 3.84)]),
    ],
)
def test_recorded_answers(text, points):
    assert np.allclose(parse_points(text, 640, 480), points, atol=0.01)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("", "the answer ''"),
        ("I cannot see it.", "the answer 'I cannot"),
        (answer("None"), "sees no handle of the mug"),
        (answer("none") + "<|im_end|>", "sees no handle"),
        (answer("<1><2><3><4>"), "<1><2><3><4>"),
        (answer("<1>"), "'<1>'"),
        (answer("<1000><2>"), "<1000>"),
        (answer("<-1><2>"), "<-1>"),
        (answer("<1.5><2>"), "<1.5>"),
        (answer("12, 34"), "'12'"),
        (answer("<1><2>,"), "''"),
        (answer("<1><2>").removesuffix("<|box_end|>"), "the answer"),
        (
            answer("<1><2>") + " <|object_ref_start|>rim<|object_ref_end|><|box_start|><3",
            "the answer",
        ),
        ("<|box_start|><1><2><|box_end|>", "the answer"),
        ("Sure: " + answer("<1><2>"), "the answer 'Sure"),
        ("x" * 1000, "…"),
    ],
)
def test_what_is_no_answer_is_refused_and_never_guessed(text, found):
    with pytest.raises(GroundingError) as error:
        parse_points(text, 640, 480, "by the handle")
    assert found in str(error.value)
    assert "by the handle" in str(error.value)


class Inputs(dict):
    def to(self, device):
        self.device = device
        return self


class FakeProcessor:
    """Records what it is asked, and decodes every token sequence to a recorded answer."""

    def __init__(self, text):
        self.text = text

    def apply_chat_template(self, messages, tokenize, add_generation_prompt):
        assert not tokenize and add_generation_prompt
        self.messages = messages
        return "chat"

    def __call__(self, text, images, padding, return_tensors):
        assert text == ["chat"] and return_tensors == "pt"
        self.image = images[0]
        return Inputs(input_ids=np.array([[5, 6, 7]]), pixel_values=np.zeros(3))

    def batch_decode(self, tokens, skip_special_tokens, clean_up_tokenization_spaces):
        assert not skip_special_tokens, "the coordinates are special tokens"
        assert tokens.tolist() == [[8, 9]], "the prompt is cut off"
        return [self.text]


class FakeModel:
    device = "cpu"

    def generate(self, input_ids, pixel_values, **settings):
        self.settings = settings
        return np.concatenate([input_ids, [[8, 9]]], axis=1)


def seen_ball(with_view=True):
    """A ball of 40 mm at 1 m in front of a camera of 100×80 pixels that looks along +x."""
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.04)
    R_wc = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], float)
    camera = PinholeCamera(100, 80, 400.0, 400.0, 50.0, 40.0, R_wc, np.zeros(3))
    depth = np.full((80, 100), 0.96)
    view = View(np.zeros((80, 100, 3), np.uint8), depth, camera, np.eye(3), np.array([1.0, 0, 0]))
    return Target("ball", mesh.vertices, mesh.faces, view=view if with_view else None)


def grounder(text, **settings):
    return RexOmniGrounder(FakeModel(), FakeProcessor(text), RexOmniConfig(**settings))


def test_an_answer_becomes_an_anchor_on_the_object():
    model = grounder(answer("<500><500>"), max_new_tokens=33)
    anchor = model.ground("in the middle of it", seen_ball())
    assert np.allclose(anchor.point, [-0.04, 0, 0], atol=2e-3)
    assert "pixel" in anchor.source
    content = model.processor.messages[1]["content"]
    assert [c["type"] for c in content] == ["image", "text"]
    assert content[1]["text"] == "Point to in the middle of it of the ball."
    assert model.processor.image.size == (100, 80)
    assert model.model.settings["max_new_tokens"] == 33
    assert model.model.settings["do_sample"] is False


def test_of_several_points_the_first_on_the_object_is_taken():
    model = grounder(answer("<10><10>,<500><520>"))
    anchor = model.ground("ball", seen_ball())
    assert np.allclose(anchor.point, [-0.04, 0, -0.0036], atol=2e-3)
    with pytest.raises(GroundingError, match="passes ball"):
        grounder(answer("<10><10>,<980><980>")).ground("ball", seen_ball())


def test_failures_are_typed():
    with pytest.raises(GroundingError, match="no picture"):
        grounder(answer("<1><2>")).ground("ball", seen_ball(with_view=False))
    with pytest.raises(GroundingError, match="sees no"):
        grounder(answer("None")).ground("ball", seen_ball())


def test_without_the_extra_the_error_says_how_to_get_it(monkeypatch):
    for name in ("torch", "transformers"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(InputError, match=r"mjx_grasp\[language\]"):
        RexOmniGrounder.load()


class FakeTorch:
    bfloat16, float32 = "bfloat16", "float32"

    class cuda:
        @staticmethod
        def is_available():
            return False


def fake_transformers(asked, error=None):
    class Model(FakeModel):
        @classmethod
        def from_pretrained(cls, name, **settings):
            if error is not None:
                raise error
            asked["model"] = (name, settings)
            return cls()

        def to(self, device):
            asked["device"] = device
            return self

        def eval(self):
            return self

    class Processor(FakeProcessor):
        @classmethod
        def from_pretrained(cls, name, **settings):
            asked["processor"] = (name, settings)
            return cls(answer("<500><500>"))

    return SimpleNamespace(AutoProcessor=Processor, Qwen2_5_VLForConditionalGeneration=Model)


def test_the_users_weights_are_loaded_on_the_device_there_is(monkeypatch):
    asked = {}
    monkeypatch.setitem(sys.modules, "torch", FakeTorch)
    monkeypatch.setitem(sys.modules, "transformers", fake_transformers(asked))
    model = RexOmniGrounder.load(RexOmniConfig(model="weights"))
    assert asked["model"] == ("weights", {"dtype": "float32"}) and asked["device"] == "cpu"
    assert asked["processor"][0] == "weights" and asked["processor"][1]["max_pixels"] == 2007040
    assert "pixel" in model.ground("ball", seen_ball()).source


def test_weights_that_are_not_there_are_a_file_error_that_names_the_licence(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", FakeTorch)
    error = OSError("nothing is not a folder\nlong story")
    monkeypatch.setitem(sys.modules, "transformers", fake_transformers({}, error))
    with pytest.raises(FileError, match=r"nothing is not a folder, expected .* research"):
        RexOmniGrounder.load(RexOmniConfig(model="nothing"))
