"""Asking Rex-Omni, a pointing model, where on a picture an instruction means.

Rex-Omni (IDEA Research) is a fine-tune of Qwen2.5-VL that answers with quantised coordinates as
tokens of its vocabulary. Prompt and answer are those of its pointing task, from Q. Jiang et al.,
"Detect Anything via Next Point Prediction", arXiv:2510.12798, and github.com/IDEA-Research/Rex-Omni
(``rex_omni/tasks.py``, ``rex_omni/parser.py``):

    Point to handle of the mug.
    <|object_ref_start|>handle of the mug<|object_ref_end|><|box_start|><412><733><|box_end|>

with several points separated by commas, and ``None`` where the model sees no such thing. A
coordinate k in 0–999 stands for the share k/999 of the picture's width or height.

The weights are the user's to get: they are licensed for research (IDEA License 1.0 and the Qwen
Research License), are not part of this package and are never downloaded by its tests. The extra
``language`` brings transformers and PyTorch, which are imported when a model is loaded.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from mjx_grasp.errors import FileError, InputError
from mjx_grasp.language.grounding import Anchor, GroundingError, Target
from mjx_grasp.language.pointing import LIMIT_M, anchor_at
from mjx_grasp.records.settings import Count, NonNegative, Positive, Settings

BINS = 1000
"""Coordinates are whole numbers below this."""

_WEIGHTS = "weights of Rex-Omni (yours to get; their licence is for research)"
_ANSWER = re.compile(
    r"<\|object_ref_start\|>\s*(.*?)\s*<\|object_ref_end\|>\s*<\|box_start\|>(.*?)<\|box_end\|>",
    re.DOTALL,
)
_POINT = re.compile(r"\s*<(\d{1,3})>\s*<(\d{1,3})>\s*")
_END = "<|im_end|>"
_SYSTEM = "You are a helpful assistant"

# What an instruction says besides where: taken off its start.
_WHERE = re.compile(r"^.*\b(?:by|at|from|near|around|onto|on)\s+", re.DOTALL)
_ACTION = re.compile(
    r"^(?:can|could|you|grasp|grab|grip|hold|pick|take|lift|touch|get|point|to|up|it|"
    r"this|the|an|a|its)\s+"
)


@dataclass(frozen=True)
class RexOmniConfig(Settings):
    """Settings of the pointing model."""

    model: str = "IDEA-Research/Rex-Omni"
    """folder of the weights, or their name on the model hub (licensed for research)"""
    device: str = "auto"
    """PyTorch device; auto takes a GPU where there is one"""
    max_new_tokens: Count = 256
    """longest answer [tokens]"""
    min_pixels: Count = 16 * 28 * 28
    """smaller pictures are enlarged to this for the model [pixels]"""
    max_pixels: Count = 2560 * 28 * 28
    """larger pictures are reduced to this for the model [pixels]"""
    repetition_penalty: Positive = 1.05
    """above 1, tokens that were said already become less likely [-]"""
    limit: NonNegative = LIMIT_M
    """how far beside the object a point may be [m]"""


class RexOmniGrounder:
    """Grounds instructions in a camera's picture with Rex-Omni; see the module's docstring.

    Args:
        model: With the ``generate`` and ``device`` of transformers' models.
        processor: With the ``apply_chat_template``, call and ``batch_decode`` of transformers'
            processors.
        config: Settings.
    """

    def __init__(self, model: Any, processor: Any, config: RexOmniConfig | None = None):
        self.model, self.processor = model, processor
        self.config = config or RexOmniConfig()

    @classmethod
    def load(cls, config: RexOmniConfig | None = None) -> RexOmniGrounder:
        """Loads the user's weights through transformers.

        Raises:
            InputError: The extra ``language`` is not installed.
            FileError: There are no such weights, or they are not Rex-Omni's.
        """
        config = config or RexOmniConfig()
        try:
            import torch
            from transformers import AutoProcessor, Qwen2_5_VLForConditionalGeneration
        except ImportError as error:
            raise _no_extra(error.name) from error
        device = config.device
        if device == "auto":
            device = "cuda" if torch.cuda.is_available() else "cpu"
        try:
            model = Qwen2_5_VLForConditionalGeneration.from_pretrained(
                config.model, dtype=torch.bfloat16 if device != "cpu" else torch.float32
            ).to(device)
            processor = AutoProcessor.from_pretrained(
                config.model, min_pixels=config.min_pixels, max_pixels=config.max_pixels
            )
        except (OSError, ValueError, RuntimeError) as error:
            first = str(error).strip().splitlines()[0] if str(error).strip() else repr(error)
            raise FileError(config.model, first, _WEIGHTS) from error
        return cls(model.eval(), processor, config)

    def ground(self, instruction: str, target: Target) -> Anchor:
        """The anchor that the model's point means; of several, the first that is on the object.

        Raises:
            GroundingError: There is no view, the model sees no such thing, its answer is not to be
                understood, or no point is on the object.
        """
        view = target.view
        if view is None:
            raise GroundingError(instruction, "no picture of the object", "a target with a view")
        text = self.answer(view.image, build_prompt(instruction, target.name))
        height, width = view.image.shape[:2]
        failures: list[GroundingError] = []
        for pixel in parse_points(text, width, height, instruction):
            try:
                return anchor_at(instruction, pixel, target, self.config.limit)
            except GroundingError as failure:
                failures.append(failure)
        raise failures[0]

    def answer(self, image: UInt8[np.ndarray, "h w 3"], prompt: str) -> str:
        """The model's raw answer about a picture, with its special tokens."""
        messages = [
            {"role": "system", "content": _SYSTEM},
            {
                "role": "user",
                "content": [{"type": "image"}, {"type": "text", "text": prompt}],
            },
        ]
        text = self.processor.apply_chat_template(
            messages, tokenize=False, add_generation_prompt=True
        )
        inputs = self.processor(
            text=[text], images=[Image.fromarray(image)], padding=True, return_tensors="pt"
        ).to(self.model.device)
        tokens = self.model.generate(
            **inputs,
            max_new_tokens=self.config.max_new_tokens,
            do_sample=False,
            repetition_penalty=self.config.repetition_penalty,
        )
        new = tokens[:, inputs["input_ids"].shape[1] :]
        # The coordinates are special tokens: they must not be skipped.
        decoded: Sequence[str] = self.processor.batch_decode(
            new, skip_special_tokens=False, clean_up_tokenization_spaces=False
        )
        return decoded[0]


def check_ready(config: RexOmniConfig) -> None:
    """Makes sure, in no time, that the extra and a folder of weights are there.

    Raises:
        FileError: There is no such folder, or no model in it.
        InputError: The extra ``language`` is not installed.
    """
    folder = Path(config.model)
    if not (folder / "config.json").is_file():
        found = "no model (no config.json)" if folder.is_dir() else "no such folder"
        raise FileError(folder, found, _WEIGHTS)
    for name in ("torch", "transformers"):
        if find_spec(name) is None:
            raise _no_extra(name)


def _no_extra(name: str | None) -> InputError:
    return InputError("extra", f"no {name}", "pip install 'mjx_grasp[language]' for Rex-Omni")


def build_prompt(instruction: str, object_name: str) -> str:
    """The pointing prompt: the place that an instruction names, of the object.

    "pick it up by the handle" for ``025_mug`` becomes "Point to handle of the mug.". Commas would
    separate things to point to, so they are dropped.

    Raises:
        GroundingError: Nothing is left of the instruction.
    """
    words = re.sub(r"[^\w\s'-]|_", " ", instruction.lower())
    place = _WHERE.sub("", " ".join(word for word in words.split() if word != "please"))
    while (shorter := _ACTION.sub("", place, count=1)) != place:
        place = shorter
    if not place:
        raise GroundingError(instruction, "no place in it", "a place, such as 'by the handle'")
    name = re.sub(r"^[\d-]+[a-z]?(?=_)", "", object_name.lower()).replace("_", " ").strip()
    whole = place if not name or name in place else f"{place} of the {name}"
    return f"Point to {whole}."


def parse_points(
    text: str, width: int, height: int, instruction: str = ""
) -> list[Float[np.ndarray, " 2"]]:
    """Pixel coordinates of the points in an answer, in the order given; at least one.

    Args:
        text: The raw answer.
        width: Of the picture [pixels].
        height: Of the picture [pixels].
        instruction: For errors.

    Raises:
        GroundingError: The answer is that there is no such thing, or it is not a complete answer
            of points.
    """
    expected = "<|object_ref_start|>…<|object_ref_end|><|box_start|><x><y><|box_end|>, x, y 0-999"
    text = text.split(_END)[0].strip()
    answers = _ANSWER.findall(text)
    rest = _ANSWER.sub("", text).strip(" ,.\n")
    if not answers or rest:
        raise GroundingError(instruction, f"the answer {_short(text)}", expected)
    points = []
    for phrase, content in answers:
        if content.strip().lower() == "none":
            continue
        for part in content.split(","):
            match = _POINT.fullmatch(part)
            if match is None:
                raise GroundingError(instruction, f"{_short(part)} for {phrase!r}", expected)
            x, y = (int(k) / (BINS - 1) for k in match.groups())
            points.append(np.array([x * width, y * height]))
    if not points:
        phrases = " or ".join(phrase for phrase, _ in answers)
        raise GroundingError(
            instruction, f"the model sees no {phrases}", "something in the picture"
        )
    return points


def _short(text: str, most: int = 120) -> str:
    return repr(text if len(text) <= most else text[:most] + "…")
