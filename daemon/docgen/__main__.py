"""`python -m shearloop.daemon.docgen`: write the generated pages into `docs/` of the checkout that this runs in."""

from shearloop.daemon.docgen.pages import ROOT, pages

for path, text in pages(ROOT).items():
    path.write_text(text, encoding="utf-8")
    print(path.relative_to(ROOT))
