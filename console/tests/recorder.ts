// A canvas that writes down what it is asked for.
import type { Context } from '../src/lib/draw';

export type Call = [name: string, ...values: unknown[]];

export function recorder(): { context: Context; calls: Call[]; alphas: number[] } {
  const calls: Call[] = [];
  const alphas: number[] = [];
  const target: Record<string, unknown> = {};
  const context = new Proxy(target, {
    get: (_, name: string) => (name in target ? target[name] : (...values: unknown[]) => calls.push([name, ...values])),
    set: (_, name: string, value) => {
      if (name === 'globalAlpha') alphas.push(value as number);
      target[name] = value;
      return true;
    },
  });
  return { context: context as unknown as Context, calls, alphas };
}
