"""Style sheet of the pages: one column, light or dark theme, from phone to desktop.

An element that is wider than the page scrolls; a shadow marks the side on which it goes on, by two
backgrounds that scroll with it over two that do not (L. Verou 2012, "Pure CSS scrolling shadows").
"""

INK, MUTED, LINE = "#1d2329", "#5c6670", "#d5dade"
DARK_INK, DARK_MUTED, DARK_LINE = "#e4e8ec", "#9aa5b0", "#38414a"

STYLE = f"""
:root{{--ink:{INK};--muted:{MUTED};--line:{LINE};--paper:#ffffff;--card:#f4f6f8;--accent:#2f6fb0;
--good:#2e7d4f;--warn:#b7791f;--bad:#b83b4b;--edge:#1d232955}}
@media (prefers-color-scheme:dark){{:root{{--ink:{DARK_INK};--muted:{DARK_MUTED};
--line:{DARK_LINE};--paper:#14181c;--card:#1d2329;--accent:#6aa9e9;--good:#59b884;--warn:#dba84a;
--bad:#e57383;--edge:#e4e8ec66}}}}
*{{box-sizing:border-box}}
body{{margin:0;background:var(--paper);color:var(--ink);
font:16px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,"Helvetica Neue",Arial,sans-serif}}
main{{max-width:1120px;margin:0 auto;padding:32px 24px 48px}}
header{{margin-bottom:16px}}
h1{{font-size:1.6rem;line-height:1.25;margin:0 0 4px;overflow-wrap:anywhere}}
h2{{font-size:1.2rem;margin:40px 0 12px;padding-top:16px;border-top:1px solid var(--line)}}
h3{{font-size:1rem;margin:20px 0 8px}}
p{{margin:0 0 12px;max-width:75ch;overflow-wrap:anywhere}}
.about,footer,figcaption,dt{{color:var(--muted);font-size:.875rem}}
.verdict{{max-width:none;margin:16px 0;padding:14px 18px;background:var(--card);
border-left:5px solid var(--accent);border-radius:4px;font-size:1.1rem}}
.good{{border-color:var(--good)}}.warn{{border-color:var(--warn)}}.bad{{border-color:var(--bad)}}
nav{{display:flex;flex-wrap:wrap;gap:4px 18px;font-size:.9rem}}
a{{color:var(--accent)}}
.facts{{display:grid;grid-template-columns:repeat(auto-fit,minmax(140px,1fr));
gap:12px;margin:16px 0}}
.facts div{{background:var(--card);border-radius:4px;padding:10px 14px}}
dd{{margin:0;font-size:1.25rem;font-variant-numeric:tabular-nums;overflow-wrap:anywhere}}
.wide{{overflow-x:auto;margin:0 0 16px;background:
linear-gradient(90deg,var(--paper) 40%,transparent) 0 0/40px 100% no-repeat local,
linear-gradient(270deg,var(--paper) 40%,transparent) 100% 0/40px 100% no-repeat local,
linear-gradient(90deg,var(--edge),transparent) 0 0/12px 100% no-repeat scroll,
linear-gradient(270deg,var(--edge),transparent) 100% 0/12px 100% no-repeat scroll}}
pre{{margin:0 0 12px;padding:10px 14px;background:var(--card);border-radius:4px;
font-size:.875rem;white-space:pre-wrap;overflow-wrap:anywhere}}
figure .wide{{margin:0 0 4px}}
.long{{min-width:11em}}
table{{border-collapse:collapse;font-size:.9rem;font-variant-numeric:tabular-nums}}
th,td{{text-align:left;padding:5px 18px 5px 0;border-bottom:1px solid var(--line);
vertical-align:top}}
th{{color:var(--muted);font-weight:600;white-space:nowrap}}
.number{{text-align:right;white-space:nowrap}}
.share{{white-space:nowrap}}
.bar{{display:inline-block;width:84px;height:.6em;margin-right:8px;background:var(--card);
border-radius:2px}}
.bar i{{display:block;height:100%;background:var(--accent);border-radius:2px}}
figure{{margin:0 0 16px}}
img{{display:block;max-width:100%;height:auto}}
.photo{{background:#fff;border-radius:4px}}
@media (prefers-color-scheme:dark){{.drawn{{filter:invert(.92) hue-rotate(180deg)}}}}
.gallery{{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(100%,440px),1fr));
gap:12px 20px}}
.gallery img{{width:100%}}
code{{font-size:.9em}}
footer{{margin-top:40px}}
@media (max-width:600px){{main{{padding:20px 14px 32px}}h1{{font-size:1.3rem}}
.verdict{{font-size:1rem;padding:12px 14px}}.long{{min-width:18em}}}}
@media print{{section{{break-inside:avoid}}nav{{display:none}}}}
"""
"""The style sheet of every page."""
