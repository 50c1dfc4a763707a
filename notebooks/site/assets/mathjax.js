// Dollar signs mark formulas in notebooks only. On other pages arithmatex marks them.
const inNotebook = document.querySelector(".jupyter-wrapper") !== null;
window.MathJax = {
  tex: {
    inlineMath: inNotebook ? [["\\(", "\\)"], ["$", "$"]] : [["\\(", "\\)"]],
    displayMath: inNotebook ? [["\\[", "\\]"], ["$$", "$$"]] : [["\\[", "\\]"]],
    processEscapes: true,
    processEnvironments: true,
  },
};
