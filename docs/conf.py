"""Settings of the documentation site: `sphinx-build -W -n --keep-going docs docs/_build/html`.

Nothing is fetched while it is built or read: formulas are drawn, fonts are those of the reader.
"""

import os
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

import rotflex_jax  # noqa: E402 - of this checkout

project = "rotflex_jax"
author = "The rotflex_jax developers"
project_copyright = author
version = release = rotflex_jax.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "generate.docstrings",
    "generate.formulas",
    "generate.pages",
]
exclude_patterns = ["_build", "_templates", "generate"]
templates_path = ["_templates"]

myst_enable_extensions = ["dollarmath", "deflist", "colon_fence", "attrs_inline"]
default_role = "code"
myst_heading_anchors = 4
suppress_warnings = ["myst.xref_not_used"]

nb_execution_mode = "off"  # notebooks are run by notebooks/build.py, the site shows what they said

html_theme = "furo"
html_title = f"rotflex_jax {version}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_theme_options = {"navigation_with_keys": True}
# The other versions, where `docs/versions.py` builds them beside this one.
html_context = {"versions": os.environ.get("ROTFLEX_DOCS_VERSIONS", "").split(), "this_version": version}
html_sidebars = {
    "**": [
        "sidebar/brand.html",
        "sidebar/search.html",
        "versions.html",
        "sidebar/scroll-start.html",
        "sidebar/navigation.html",
        "sidebar/scroll-end.html",
    ]
}
html_math_renderer = "outlines"
html_show_sphinx = False

napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True
napoleon_attr_annotations = False  # sizes of arrays would be read as markup
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
autodoc_default_options = {"exclude-members": "__init__, __new__"}
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88
add_module_names = False
copybutton_exclude = ".linenos, .gp, .go"

# Types of other packages, and of annotations that are no names: there is nothing here to link to.
nitpick_ignore_regex = [
    ("py:.*", r"(numpy|jax|jaxlib|jaxtyping|collections|pathlib|os|rich|matplotlib|typing|pandas)\b.*"),
    ("py:.*", r"ndarray|Figure|Minimiser|EffectClass|EffectType|.*\.Effect(Class|Type)|dict.*|tuple.*"),
    ("py:class", r"'[A-Za-z0-9_*. -]*'?|[A-Z]( [A-Z])*"),  # sizes of arrays
    ("py:class", r"_Buffer|_SupportsArray|_NestedSequence"),  # what NumPy takes for an array
    # Small types of results, told where they are used.
    ("py:class", r"rotflex_jax\.discover\.\w+\.(Assessment|ConditionalInterval|FinalFit|HorizonGain)"),
    ("py:class", r"rotflex_jax\.discover\.\w+\.(ModelTests|RunErrors)"),
    ("py:class", r"rotflex_jax\.(arena|experiment)\.\w+\.(Event|Share|SequentialStep)"),
    ("py:class", r"rotflex_jax\.latent\.\w+\.(Drift|PeriodicTorque)"),
    ("py:class", r"rotflex_jax\.(fit|mechanism|runtime)\.\w+\.(LoadRows|Performance|Remark)"),
]
