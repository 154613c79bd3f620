// The present, once a second, for ages that grow.
class Ticker {
  now_ms = $state(Date.now());

  constructor() {
    setInterval(() => {
      if (!document.hidden) this.now_ms = Date.now();
    }, 1000);
  }
}

export const ticker = new Ticker();
