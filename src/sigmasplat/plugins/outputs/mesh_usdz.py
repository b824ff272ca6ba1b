"""Write a textured surface as USDZ, which phones and Macs of Apple show in Quick Look: a zip file without compression
of a text scene and the texture, each beginning at a multiple of 64 bytes (OpenUSD, USDZ specification).

The colours contain the light of the room, so they are emitted, and the surface reflects nothing.
"""

import zipfile
from io import BytesIO

import numpy as np
from numpy.typing import NDArray

from sigmasplat.api import Mesh, RunError
from sigmasplat.plugins.outputs.mesh_texture import TexturedMesh

ALIGNED, HEADER = 64, 30
"""Bytes of which the contents start at a multiple, and bytes of the header of a part of a zip file without its name."""
WHEN = (1980, 1, 1, 0, 0, 0)
"""The time of the parts: the earliest of a zip file, so that the same surface gives the same bytes."""
SCENE = """#usda 1.0
(
    defaultPrim = "surface"
    metersPerUnit = 1
    upAxis = "Y"
)

def Xform "surface" ( kind = "component" )
{{
    def Mesh "mesh" ( prepend apiSchemas = ["MaterialBindingAPI"] )
    {{
        uniform bool doubleSided = 1
        uniform token subdivisionScheme = "none"
        float3[] extent = [{extent}]
        int[] faceVertexCounts = [{counts}]
        int[] faceVertexIndices = [{corners}]
        point3f[] points = [{points}]
        normal3f[] normals = [{normals}] ( interpolation = "vertex" )
        texCoord2f[] primvars:st = [{uv}] ( interpolation = "vertex" )
        rel material:binding = </surface/material>
    }}
    def Material "material"
    {{
        token outputs:surface.connect = </surface/material/light.outputs:surface>
        def Shader "light"
        {{
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:diffuseColor = (0, 0, 0)
            color3f inputs:emissiveColor.connect = </surface/material/texture.outputs:rgb>
            float inputs:metallic = 0
            float inputs:roughness = 1
            int inputs:useSpecularWorkflow = 1
            color3f inputs:specularColor = (0, 0, 0)
            token outputs:surface
        }}
        def Shader "texture"
        {{
            uniform token info:id = "UsdUVTexture"
            asset inputs:file = @texture.jpg@
            token inputs:sourceColorSpace = "sRGB"
            token inputs:wrapS = "clamp"
            token inputs:wrapT = "clamp"
            float2 inputs:st.connect = </surface/material/place.outputs:result>
            float3 outputs:rgb
        }}
        def Shader "place"
        {{
            uniform token info:id = "UsdPrimvarReader_float2"
            string inputs:varname = "st"
            float2 outputs:result
        }}
    }}
}}
"""


def usdz(mesh: Mesh, note: str) -> bytes:
    """Return a textured mesh whose y axis points up as the bytes of a USDZ file. Raises RunError without a texture."""
    if not isinstance(mesh, TexturedMesh):
        raise RunError("a USDZ needs a surface with a texture, found none; write a GLB, PLY or STL")
    scene = SCENE.format(
        extent=_rows(np.stack([mesh.vertices.min(0), mesh.vertices.max(0)]), "%.5g"),
        counts=", ".join(["3"] * len(mesh.faces)),
        corners=", ".join(map(str, mesh.faces.ravel().tolist())),
        points=_rows(mesh.vertices, "%.7g"),
        normals=_rows(mesh.normals(), "%.3f"),
        uv=_rows(mesh.uv * (1, -1) + (0, 1), "%.6f"),  # USD counts from the lower left corner
    )
    file = BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, content in (("surface.usda", scene.encode()), ("texture.jpg", mesh.image)):
            part = zipfile.ZipInfo(name, WHEN)
            fill = -(file.tell() + HEADER + len(name)) % ALIGNED
            fill += ALIGNED * (0 < fill < 4)  # the header of an extra field has 4 bytes
            part.extra = np.array([0x1986, fill - 4], "<u2").tobytes() + bytes(fill - 4) if fill else b""
            archive.writestr(part, content)
    return file.getvalue()


def _rows(values: NDArray[np.floating], number: str) -> str:
    """Return rows of numbers as tuples of USD."""
    row = "(" + ", ".join([number] * values.shape[1]) + ")"
    return ", ".join(row % tuple(each) for each in values.tolist())
