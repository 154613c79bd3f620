// A table that is wider than its place scrolls: also by the keyboard, and under a name.

export function scrollRegion(element: HTMLElement): () => void {
  function update(): void {
    if (element.scrollWidth <= element.clientWidth) {
      element.removeAttribute('tabindex');
      return;
    }
    element.tabIndex = 0;
    element.setAttribute('role', 'region');
    element.setAttribute('aria-label', element.closest('section')?.querySelector('h2, h3')?.textContent ?? '');
  }
  const observer = new ResizeObserver(update);
  observer.observe(element);
  for (const child of element.children) observer.observe(child);
  return () => observer.disconnect();
}
