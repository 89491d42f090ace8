// The theme adds bars of buttons to commands and boxes to tables while a page is open. Here the bars get names, and what
// scrolls sideways is within the keyboard's reach.
const mend = () => {
  document.querySelectorAll(".md-code__nav").forEach((bar, i) => bar.setAttribute("aria-label", `Code ${i + 1}`))
  for (const box of document.querySelectorAll(".md-typeset__scrollwrap, .md-typeset pre > code")) {
    if (box.scrollWidth > box.clientWidth && box.tabIndex < 0) box.tabIndex = 0
  }
}
let waiting = false
const soon = () => {
  if (waiting) return
  waiting = true
  requestAnimationFrame(() => {
    waiting = false
    mend()
  })
}
new MutationObserver(soon).observe(document.body, { childList: true, subtree: true, attributeFilter: ["tabindex"] })
addEventListener("resize", soon)
soon()
