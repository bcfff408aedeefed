"""From an instruction to an anchor on the object (method §1, language).

Two grounders behind one protocol: `parts.PartGrounder` knows named parts and sides and needs
nothing; `rex_omni.RexOmniGrounder` asks a pointing model about a camera's picture.
"""
