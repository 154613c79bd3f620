// A table that is larger than its frame scrolls: also by the keyboard, and under a name.

export function scrollRegion(element: HTMLElement): () => void {
  function update(): void {
    if (element.scrollWidth <= element.clientWidth && element.scrollHeight <= element.clientHeight) {
      for (const name of ['tabindex', 'role', 'aria-label']) element.removeAttribute(name);
      return;
    }
    element.tabIndex = 0;
    element.setAttribute('role', 'region');
    const part = element.closest(':has(> h3, > h2, > header > h2, > header > h3)');
    element.setAttribute('aria-label', part?.querySelector('h2, h3')?.textContent ?? '');
  }
  const observer = new ResizeObserver(update);
  observer.observe(element);
  for (const child of element.children) observer.observe(child);
  return () => observer.disconnect();
}
