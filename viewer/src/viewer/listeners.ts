// Who listens to which event.
export class Listeners<Events> {
  private readonly sets = new Map<keyof Events, Set<(event: never) => void>>();

  /** Listen to an event. Returns a function that ends it. */
  on<Name extends keyof Events>(name: Name, listener: (event: Events[Name]) => void): () => void {
    const set = this.sets.get(name) ?? new Set();
    this.sets.set(name, set.add(listener));
    return () => set.delete(listener);
  }

  emit<Name extends keyof Events>(name: Name, event: Events[Name]): void {
    for (const listener of this.sets.get(name) ?? []) (listener as (event: Events[Name]) => void)(event);
  }
}
