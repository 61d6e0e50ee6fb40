// Formulas (docs/tex.py marks them) are set by KaTeX as MathML, which browsers draw with their own fonts.
for (const place of document.querySelectorAll(".tex")) {
  katex.render(place.textContent, place, {
    output: "mathml", displayMode: place.tagName === "DIV", throwOnError: false, strict: false,
  });
}
