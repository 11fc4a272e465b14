"""`python -m daemon.handbook`: write the generated pages into `docs/` of the checkout that this runs in."""

from daemon.handbook.pages import ROOT, pages

for path, text in pages(ROOT).items():
    path.write_text(text, encoding="utf-8")
    print(path.relative_to(ROOT))
