// Short messages of what was done or refused.
import { failureOf, type Failure } from './failure';

export interface Toast {
  id: number;
  message: Failure;
  kind: 'good' | 'error';
}

class ToastList {
  items = $state<Toast[]>([]);
  #next = 1;

  #add(message: Failure, kind: Toast['kind']): void {
    const id = this.#next++;
    this.items.push({ id, message, kind });
    setTimeout(() => this.remove(id), kind === 'error' ? 12_000 : 5_000);
  }

  good(text: string): void {
    this.#add({ text }, 'good');
  }

  error(error: unknown): void {
    this.#add(failureOf(error), 'error');
  }

  remove(id: number): void {
    this.items = this.items.filter((toast) => toast.id !== id);
  }

  /** Runs what a button asks for; a refusal becomes a message. */
  async attempt<T>(action: () => Promise<T>, done?: string): Promise<T | undefined> {
    try {
      const value = await action();
      if (done) this.good(done);
      return value;
    } catch (error) {
      this.error(error);
      return undefined;
    }
  }
}

export const toasts = new ToastList();
