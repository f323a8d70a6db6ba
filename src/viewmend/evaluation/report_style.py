"""How a report's page looks, on light and dark, on a desk and on a phone."""

STYLE = """
:root { color-scheme: light dark; --back: #fff; --front: #1a1a1a; --soft: #f2f2f2; --line: #d0d0d0; --accent: #0b62c4; }
@media (prefers-color-scheme: dark) {
  :root { --back: #16181b; --front: #e8e8e8; --soft: #23262b; --line: #43474d; --accent: #6cb2ff; }
}
* { box-sizing: border-box; }
body { margin: 0; background: var(--back); color: var(--front); font: 16px/1.5 system-ui, sans-serif; }
main { max-width: 1500px; margin: 0 auto; padding: 1rem; }
h1 { font-size: 1.6rem; } h2 { margin-top: 2.2rem; } h3 { margin: 1.6rem 0 .4rem; overflow-wrap: anywhere; }
p, li { max-width: 80ch; overflow-wrap: anywhere; }
.wide { overflow-x: auto; max-width: 100%; }
table { border-collapse: collapse; font-size: .86rem; font-variant-numeric: tabular-nums; }
th, td { padding: .3rem .6rem; border-bottom: 1px solid var(--line); text-align: right; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; position: sticky; left: 0; background: var(--back); }
thead th { background: var(--soft); } thead th:first-child { background: var(--soft); }
tbody tr:hover td { background: var(--soft); }
.plot { display: block; width: 100%; min-width: 560px; max-width: 900px; height: auto; margin: 1rem 0; }
.dot use { fill: var(--accent) !important; stroke: none !important; }
details { margin: .6rem 0; } summary { cursor: pointer; color: var(--accent); padding: .3rem 0; }
section { border-top: 1px solid var(--line); }
.views { display: flex; gap: .5rem; align-items: flex-start; padding-bottom: .6rem; }
figure { margin: 0; flex: 1 0 130px; max-width: 240px; }
figure:last-child {
  position: sticky; right: 0; align-self: stretch; background: var(--back); box-shadow: -.5rem 0 var(--back);
}
figcaption { font-size: .82rem; min-height: 3em; overflow-wrap: anywhere; }
figure img { display: block; width: 100%; height: auto; margin-bottom: .3rem; background: #000; }
img.png { image-rendering: pixelated; }
.none { background: var(--soft); padding: 2rem .5rem; text-align: center; }
video { display: block; max-width: 100%; height: auto; background: #202020; }
@media (max-width: 600px) { main { padding: .7rem; } figure { flex-basis: 110px; } h1 { font-size: 1.3rem; } }
"""
