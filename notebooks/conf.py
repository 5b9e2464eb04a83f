"""The site: these notebooks and pages, and the reference from docstrings. `sphinx-build -W notebooks site` makes it."""

import inspect
import logging
import operator
import re

import equinox as eqx

import linkax as lx

project = "linkax"
author = copyright = "The linkax authors"
extensions = ["sphinx.ext.autodoc", "myst_nb", "sphinx_copybutton"]
exclude_patterns = ["data"]
highlight_language = "none"
html_theme = "furo"
html_title = "linkax"
html_show_sourcelink = False
html_static_path = ["_static"]
html_css_files = ["site.css"]
nitpicky = True

nb_execution_mode = "off"  # notebooks show the outputs that they keep
nb_merge_streams = True
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3

autodoc_typehints = "none"  # docstrings say shape, unit and meaning
autodoc_preserve_defaults = True
autodoc_member_order = "bysource"

# What linkax makes and its users read, without signature; named tuples are such too, but for those that users make.
READ = {"Attached", "Frame", "Load", "Mobility", "Motion", "Moving", "Solution", "View"}
WRITTEN = {"Inertia", "Pose", "Stepping", "Velocity"}
# Classes whose methods users call; those of others are for linkax, as it moves joints and adds up forces.
CALLED = {
    "AbstractConstraint",
    "AbstractForce",
    "Attached",
    "Beam",
    "Fit",
    "Linearisation",
    "Machine",
    "Mechanism",
    "Mobility",
    "Motion",
    "Moving",
    "RigidBody",
    "Solution",
}
CALLED |= {"Sweep", "Trace", "View", "Workspace"}
# What linkax itself calls of them.
INTERNAL = {
    "of_run",
    "another",
    "known_dynamics",
    "joint_speeds",
    "cut_speeds",
    "joint_rate",
    "within",
    "element_length",
}
INTERNAL |= {"fastest_frequency", "nodes", "sections", "section_name", "needs_coordinate", "display_name"}
INTERNAL |= {"conserves_energy", "switched", "side", "applied", "held"}
INTERNAL |= {
    "checked_residual",
    "check_residual",
    "checked_slip",
    "num_rows",
    "attached",
    "moving",
    "still",
    "row_scales",
    "pose",
    "coordinate",
}


def described(name):
    """Whether the site describes what is called so, such as "Solution.energy"."""
    first, _, rest = name.partition(".")
    if first not in lx.__all__ or rest.startswith("_") or rest in INTERNAL:
        return False
    thing = getattr(lx, first)
    if inspect.isclass(thing):
        entry = next((vars(kind)[rest] for kind in thing.__mro__ if rest in vars(kind)), None)
        return not rest or (first in CALLED and (inspect.isroutine(entry) or isinstance(entry, property)))
    return not rest or (inspect.ismodule(thing) and hasattr(thing, rest))


def directives(names):
    """Those of autodoc for public names."""
    for name in names:
        thing = operator.attrgetter(name)(lx)
        if inspect.isclass(thing) and issubclass(thing, Exception):
            yield f".. autoexception:: linkax.{name}()"
        elif inspect.isclass(thing):
            yield f".. autoclass:: linkax.{name}"
            yield from ["   :members:", "   :inherited-members: Module"] if name in CALLED else []
            yield from ["   :class-doc-from: both"] if name == "AbstractJoint" else []  # its arguments are all joints'
        elif inspect.isroutine(thing):
            yield f".. autofunction:: linkax.{name}"
        elif inspect.ismodule(thing):
            yield f".. automodule:: linkax.{name}"
        else:
            yield from [f".. autodata:: linkax.{name}", "   :no-value:"]
        yield ""


def read_page(app, docname, source):
    """In pages of Markdown, `lx.name` in backticks is a link, and a block {api} describes the names in it."""
    if app.env.doc2path(docname).suffix != ".md":
        return
    parts = re.split(r"(^```.*?^```$)", source[0], flags=re.DOTALL | re.MULTILINE)
    for index, part in enumerate(parts):
        if part.startswith("```{api}"):
            parts[index] = "\n".join(["```{eval-rst}", *directives(part.split()[1:-1]), "```"])
        elif not part.startswith("```"):
            parts[index] = re.sub(r"`lx\.([\w.]+)`", r"{py:obj}`lx.\1 <linkax.\1>`", part)
    source[0] = "".join(parts)


def read_docstring(app, what, name, thing, options, lines):
    """Docstrings are Markdown: into reStructuredText, with links where names in backticks are public."""
    if isinstance(thing, type) and issubclass(thing, eqx.Enumeration):
        inherited = getattr(thing.__base__, "_name_to_item", {})
        own = [entry for entry in thing._name_to_item if entry not in inherited and thing[getattr(thing, entry)]]
        lines += ["", *(f"- `{entry}`: {thing[getattr(thing, entry)]}" for entry in own)]
    owner = name.split(".")[1]
    translated, code, inside = [], False, False
    for line in lines:
        if line.startswith("```"):
            code = not code
            translated += ["", f".. code-block:: {line[3:] or 'text'}", ""] if code else [""]
            continue
        if code:
            translated.append("   " + line)
            continue
        item = line.startswith("- ")
        if item and not inside:
            translated.append("")
        inside = (item or inside) and bool(line.strip()) and (item or line.startswith(" "))
        translated.append("".join(_inline(part, owner) for part in re.split(r"(`[^`]*`)", line)))
    lines[:] = translated


def _inline(part, owner):
    if not part.startswith("`"):
        return re.sub(r"\||_(?=\W|$)|(?<!\*)\*(?=\w)", r"\\\g<0>", part)
    text = part.strip("`")
    name = text.removeprefix("linkax.").removeprefix("lx.").removesuffix("()")
    for full in (name, f"{owner}.{name}"):
        if described(full):
            return f":py:obj:`{text} <linkax.{full}>`"
    return f"``{text}``"


def read_signature(app, what, name, thing, options, signature, returns):
    if what != "class":
        return signature, None
    short = thing.__name__
    tuple_read = issubclass(thing, tuple) and short not in WRITTEN
    hidden = tuple_read or short in READ or issubclass(thing, eqx.Enumeration)
    # Numbers of defaults are arrays.
    return ("" if hidden or signature is None else re.sub(r"\(\w+=f64[^)]*\)[^)]*\)[^)]*\)", "()", signature)), None


def skip(app, what, name, thing, skipped, options):
    """Fields of named tuples, which the docstring of the class says, and what linkax calls itself."""
    return True if type(thing).__name__ == "_tuplegetter" or name in INTERNAL else None


def setup(app):
    # A folder without these notebooks is no mistake.
    logging.getLogger("sphinx.sphinx.directives.other").addFilter(lambda told: "didn't match" not in told.msg)
    app.connect("source-read", read_page)
    app.connect("autodoc-process-docstring", read_docstring)
    app.connect("autodoc-process-signature", read_signature)
    app.connect("autodoc-skip-member", skip)
