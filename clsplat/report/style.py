"""The style sheet of the pages: for wide screens and telephones, light and dark, and for paper."""

STYLE = """
:root { color-scheme: light dark; --ink: #1d1f21; --soft: #565b60; --line: #e3e4e6;
  --rule: #b9bdc1; --paper: #fcfcfb; --shadow: #0000002e; --alert: #fff4dc; }
* { box-sizing: border-box; }
body { margin: 2.5rem auto 4rem; max-width: 70rem; padding: 0 1.5rem; background: var(--paper);
  color: var(--ink); font: 16px/1.5 system-ui, "Segoe UI", Roboto, "Helvetica Neue", sans-serif; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: 0 0 .4rem; font-weight: 680;
  overflow-wrap: anywhere; }
h2 { font-size: 1.2rem; line-height: 1.3; margin: 2.8rem 0 .6rem; font-weight: 680; }
p { margin: .4rem 0; max-width: 50rem; overflow-wrap: anywhere; }
.lead { font-size: 1.05rem; color: var(--soft); }
.note { font-size: .875rem; color: var(--soft); }
.facts { font-size: .875rem; color: var(--soft); margin-top: .8rem; }
.facts code { overflow-wrap: anywhere; }
.warning { background: var(--alert); border-left: 3px solid #d98e04; padding: .5rem .9rem;
  max-width: 62rem; }
img { display: block; width: 100%; }
.plate { margin: .6rem 0; padding: .3rem; }
picture img { margin: .6rem 0; }
details { margin-top: 1.6rem; border-top: 1px solid var(--line); padding-top: 1rem; }
summary { cursor: pointer; font-size: 1.05rem; font-weight: 680; }

/* a table that is too wide scrolls, and a shadow shows at which side it goes on */
.scroll { overflow-x: auto; margin: .6rem 0; background:
  linear-gradient(to right, var(--paper) 30%, transparent) 0 0 / 3rem 100% no-repeat local,
  linear-gradient(to left, var(--paper) 30%, transparent) 100% 0 / 3rem 100% no-repeat local,
  linear-gradient(to right, var(--shadow), #0000) 0 0 / .8rem 100% no-repeat scroll,
  linear-gradient(to left, var(--shadow), #0000) 100% 0 / .8rem 100% no-repeat scroll; }
table { border-collapse: collapse; font-size: .94rem; font-variant-numeric: tabular-nums; }
th, td { padding: .35rem .95rem .35rem 0; text-align: left; vertical-align: top; }
th { font-weight: 600; font-size: .85rem; color: var(--soft); border-bottom: 1px solid var(--rule);
  vertical-align: bottom; }
td { border-bottom: 1px solid var(--line); }
td:not(.number) { min-width: 3.6rem; }
.pairs td { overflow-wrap: anywhere; }
.number { text-align: right; white-space: nowrap; overflow-wrap: normal; }
td:first-child { white-space: nowrap; }
th:last-child, td:last-child { padding-right: 0; }

/* the pictures: three beside each other, below each other where there is no room */
h3 { font-size: 1rem; font-weight: 680; margin: 1.6rem 0 .3rem; overflow-wrap: anywhere; }
.view { margin: 1.4rem 0 2rem; }
.view h3 { margin: 0; }
.view p { margin: .1rem 0 .5rem; font-variant-numeric: tabular-nums; color: var(--soft); }
.panels { display: grid; grid-template-columns: repeat(3, 1fr); gap: .7rem; }
figure { margin: 0; }
figcaption { font-size: .875rem; color: var(--soft); margin-top: .25rem; }
.scale { display: flex; align-items: center; gap: .6rem; font-size: .875rem; color: var(--soft);
  margin: .5rem 0; }
.scale b { font-weight: 400; white-space: nowrap; }
.scale i { flex: 0 1 14rem; height: .8rem; border-radius: 2px; }

@media screen and (prefers-color-scheme: dark) {
  :root { --ink: #e4e6e8; --soft: #a6acb2; --line: #33373b; --rule: #5c6166; --paper: #17191b;
    --shadow: #ffffff38; --alert: #3b2d0c; }
  picture img { filter: invert(1) hue-rotate(180deg); }  /* drawn in dark lines on nothing */
  .scroll > img, .plate { background: #fcfcfb; border-radius: 3px; }
  .plate img { filter: none; }
}

/* colours mean something here; what is folded cannot be opened on paper, and nothing scrolls */
@media print {
  * { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
  body { margin: 0; max-width: none; padding: 0; font-size: 11pt; background: none; }
  h1, h2, h3, summary, .scale { break-after: avoid; }
  .view, figure, picture, img, tr, .warning { break-inside: avoid; }
  details::details-content { content-visibility: visible; block-size: auto; }
  picture img { width: auto; max-width: 100%; max-height: 22cm; }
  .scroll { overflow: visible; background: none; }
  table { font-size: 8pt; }
  th, td { padding: .12rem .7rem .12rem 0; }
  details { columns: 2; }
  details > :not(.scroll) { column-span: all; }
  td, .number { white-space: normal; }
}

@media screen and (max-width: 40rem) {
  body { margin: 1.2rem auto 3rem; padding: 0 1rem; }
  h1 { font-size: 1.45rem; }
  h2 { margin-top: 2.2rem; }
  .panels { grid-template-columns: 1fr; }
  .view { margin-bottom: 2.4rem; }
  th:first-child, td:first-child { position: sticky; left: 0; background: var(--paper);
    white-space: normal; max-width: 9rem; }
  .scroll > img { width: 44rem; max-width: none; }
  .pairs, .pairs tbody, .pairs tr, .pairs td { display: block; }
  .pairs thead { display: none; }
  .pairs tr { border-bottom: 1px solid var(--line); padding: .45rem 0; }
  .pairs td { border: 0; padding: 0; }
  .pairs td:first-child { font-size: .85rem; color: var(--soft); max-width: none;
    position: static; }
}
"""
