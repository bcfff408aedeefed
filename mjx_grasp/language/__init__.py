"""From an instruction to an anchor on the object (method §1, language).

Two grounders behind one protocol: `parts.PartGrounder` knows named parts and sides and needs
nothing; `rex_omni.RexOmniGrounder` asks a pointing model about a camera's picture.
"""

from mjx_grasp.language.grounding import Anchor, Grounder, GroundingError, Target, View
from mjx_grasp.language.parts import PartGrounder
from mjx_grasp.language.rex_omni import RexOmniConfig, RexOmniGrounder

__all__ = [
    "Anchor",
    "Grounder",
    "GroundingError",
    "PartGrounder",
    "RexOmniConfig",
    "RexOmniGrounder",
    "Target",
    "View",
]
