"""Hooks of the site: generated pages, links between the repository and the site, alternative text.

The pages are read in two places: in the repository, where links name files, and on the site. Pages
therefore link files of the repository, and these hooks replace the links.
"""

import ast
import base64
import hashlib
import html
import json
import re
from pathlib import Path

from mkdocs.structure.files import File
from mkdocs.utils import get_relative_url
from mkdocs.utils.meta import get_data

SITE = Path(__file__).parent
DOCS, ROOT = SITE.parent, SITE.parents[1]
# Files of the repository that are pages of the site.
ROOT_PAGES = {
    "README.md": "index.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
}
ROOT_FILES = ("CITATION.cff", "LICENSE")
SECTIONS = {
    "howto": ("How-to guides", "Each page solves one task."),
    "explanation": ("Explanation", "The mathematics behind the methods, and their limits."),
}


def on_files(files, config):
    for source, page in ROOT_PAGES.items():
        if page != "index.md":
            text = (ROOT / source).read_text(encoding="utf-8")
            files.append(File.generated(config, page, content=_from_root(text)))
    for name in ROOT_FILES:
        files.append(File.generated(config, name, content=(ROOT / name).read_bytes()))
    for asset in sorted((SITE / "assets").iterdir()):
        files.append(File.generated(config, f"assets/{asset.name}", abs_src_path=str(asset)))
    for folder in SECTIONS:
        text = _index(folder, config)
        files.append(File.generated(config, f"{folder}/index.md", content=text))
    for notebook in sorted(DOCS.glob("*.ipynb")):
        for number, picture in enumerate(_pictures(notebook), 1):
            path = f"gallery/{notebook.stem}-{number}.png"
            files.append(File.generated(config, path, content=picture))
    return files


def _index(folder, config):
    """Return the first page of a section: its pages in the order of the navigation."""
    title, summary = SECTIONS[folder]
    lines = [f"# {title}", "", summary, ""]
    for name in re.findall(rf"'{folder}/(\w+\.md)'", str(config.nav)):
        if name != "index.md":
            heading, sentence = _opening((DOCS / folder / name).read_text(encoding="utf-8"))
            lines.append(f"- [{heading}]({name}). {sentence}")
    return "\n".join(lines) + "\n"


def _opening(text):
    """Return the title of a page and its first sentence, without links."""
    heading, *paragraphs = text.split("\n\n")
    prose = next((part for part in paragraphs if re.match(r"[A-Z`*]", part)), "")
    sentence = re.split(r"(?<=[.:])\s", prose.replace("\n", " "))[0]
    return heading.lstrip("# ").strip(), re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", sentence)


def _pictures(notebook):
    """Return the pictures of a notebook as bytes, in order."""
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    return [
        base64.b64decode("".join(output["data"]["image/png"]))
        for cell in cells
        for output in cell.get("outputs", [])
        if "image/png" in output.get("data", {})
    ]


def _from_root(text):
    """Rewrite links of a file at the top level for a page at the top of the site."""
    text = text.replace("](notebooks/", "](")
    for source, page in ROOT_PAGES.items():
        text = text.replace(f"]({source}", f"]({page}")
    return text


def _section(name):
    """Return the body of a section of README."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    return _from_root(re.search(rf"^## {re.escape(name)}\n(.*?)(?=^## |\Z)", text, re.M | re.S)[1])


def on_page_markdown(markdown, page, config, files):
    markdown = re.sub(r"<!-- README: (.*?) -->", lambda found: _section(found[1]).strip(), markdown)
    if page.file.src_uri == "tutorials.md":
        markdown = _gallery(markdown, page.meta["pictures"])
    return re.sub(r"\]\(((?:\.\./)+)([\w.]+)(#[^)]*)?\)", _root_link, markdown)


def _root_link(found):
    up, name, anchor = found.groups()
    if name in ROOT_PAGES:
        name = ROOT_PAGES[name]
        # The first page has some sections of README only.
        anchor = "" if name == "index.md" else anchor or ""
    elif name not in ROOT_FILES:
        return found[0]
    return f"]({up.removeprefix('../')}{name}{anchor or ''})"


def _gallery(markdown, pictures):
    """Turn the list of notebooks into cards with pictures."""

    def card(found):
        title, notebook, text = found.groups()
        stem = notebook.removesuffix(".ipynb")
        image = f"![Picture of the tutorial: {title}](gallery/{stem}-{pictures[stem]}.png)"
        text = text.strip().replace("\n  ", "\n    ")
        return f"-   [{image}]({notebook})\n\n    **[{title}]({notebook})**\n\n    {text}\n\n"

    item = r"^- \[([^\]]*)\]\((\w+\.ipynb)\): (.*\n(?:  .*\n)*)"
    before, *_ = re.split(item, markdown, maxsplit=1, flags=re.M)
    cards = "".join(card(found) for found in re.finditer(item, markdown, re.M))
    after = re.sub(item, "", markdown.removeprefix(before), flags=re.M)
    return f'{before}<div class="grid cards" markdown>\n\n{cards}</div>\n{after}'


def _public_names():
    """Return the names of `jaxbridge.__all__`."""
    tree = ast.parse((ROOT / "jaxbridge/__init__.py").read_text(encoding="utf-8"))
    for node in tree.body:
        if isinstance(node, ast.Assign) and node.targets[0].id == "__all__":
            return frozenset(ast.literal_eval(node.value))
    raise ValueError("jaxbridge/__init__.py has no `__all__`.")


NAMES = _public_names()


def on_page_content(content, page, config, files):
    if page.file.src_uri.endswith(".ipynb"):
        content = _describe_pictures(content, page)
        content = _link_pages(content, page, files)
        content = _without_shared_parts(content, page)
        _mend_contents(content, page)
        content = _with_front_picture(content, page)
    return _link_names(content)


def on_post_build(config):
    for name, style in STYLES.items():
        (Path(config.site_dir) / name).write_text(style, encoding="utf-8")


# Style sheets of notebooks, by their paths on the site.
STYLES = {}


def _without_shared_parts(content, page):
    """Move the large style sheet, which all notebooks share, to a file; drop unused scripts."""

    def link(found):
        if len(found[1]) < 100_000:
            return found[0]
        name = f"assets/notebook-{hashlib.sha256(found[1].encode()).hexdigest()[:8]}.css"
        STYLES[name] = found[1]
        return f'<link rel="stylesheet" href="{get_relative_url(name, page.url)}">'

    content = re.sub(r"<style[^>]*>(.*?)</style>", link, content, flags=re.S)
    # Configurations of MathJax 2 and Mermaid, which the pages do not use.
    unused = r'<script (?:src=""|type="text/x-mathjax-config"|type="module")>.*?</script>'
    return re.sub(unused, "", content, flags=re.S)


def _link_pages(content, page, files):
    """Replace links from a notebook to files of the repository by links to pages of the site."""

    def link(found):
        name, anchor = found["name"], found["anchor"] or ""
        target = files.get_file_from_path(ROOT_PAGES.get(name.removeprefix("../"), name))
        if target is None:
            return found[0]
        return f'href="{target.url_relative_to(page.file)}{anchor}"'

    return re.sub(r'href="(?P<name>[\w./]+\.(?:ipynb|md))(?P<anchor>#[^"]*)?"', link, content)


def _mend_contents(content, page):
    """Correct the table of contents of a notebook, in which code of headings is missing."""
    headings = re.findall(r'<h[1-6] id="([^"]+)"[^>]*>(.*?)</h[1-6]>', content, re.S)

    def flat(items):
        for item in items:
            yield item
            yield from flat(item.children)

    for item, (name, title) in zip(flat(page.toc), headings, strict=True):
        item.id, item.title = name, re.sub(r"<[^>]*>|¶", "", title).strip()


def _with_front_picture(content, page):
    """Begin a notebook with the picture of its card in the gallery."""
    text = (DOCS / "tutorials.md").read_text(encoding="utf-8")
    stem = Path(page.file.src_uri).stem
    path = f"gallery/{stem}-{get_data(text)[1]['pictures'][stem]}.png"
    source = get_relative_url(path, page.url)
    picture = f'<p class="front"><img alt="Picture from this tutorial" src="{source}"></p>'
    return content.replace("</h1>", f"</h1>{picture}", 1)


def _describe_pictures(content, page):
    """Give each picture of a notebook without alternative text the title of its section."""
    section = page.title or ""

    def replace(found):
        nonlocal section
        if found["title"] is not None:
            section = html.escape(re.sub(r"<[^>]*>|¶", "", found["title"]).strip(), quote=True)
            return found[0]
        return f'alt="Picture of the section: {section}"'

    pattern = r'<h[1-4][^>]*>(?P<title>.*?)</h[1-4]>|alt="No description[^"]*"'
    return re.sub(pattern, replace, content, flags=re.S)


def _link_names(content):
    """Link each public name in code style, `smooth` or `jb.smooth`, to the reference."""
    without_links = {"a", "autoref", "pre", "h1", "h2", "h3", "h4", "h5", "h6"}
    depth, parts = 0, []
    for part in re.split(r"(<code>[^<]*</code>|</?\w+[^>]*>)", content):
        if name := re.fullmatch(r"<code>(?:jb\.)?(\w+)(?:\([^<]*\))?</code>", part):
            if not depth and name[1] in NAMES:
                part = f'<autoref identifier="jaxbridge.{name[1]}" optional>{part}</autoref>'
        elif (tag := re.match(r"<(/?)(\w+)", part)) and tag[2] in without_links:
            depth += -1 if tag[1] else 1
        parts.append(part)
    return "".join(parts)
