// GLSL templates: a placeholder is a name in double braces, {{LIKE_THIS}}.

const PLACEHOLDER = /\{\{(.*?)\}\}/g;

/**
 * Replace each placeholder of `template` by the string of that name in `values`. Placeholders inside the values stay as they are.
 *
 * Throws an Error when the template has a placeholder without a value, or when a value has no placeholder.
 */
export function fillTemplate(template: string, values: Readonly<Record<string, string>>): string {
  const used = new Set<string>();
  const text = template.replace(PLACEHOLDER, (_, name: string) => {
    if (!Object.hasOwn(values, name)) throw new Error(`The shader template has an unknown placeholder {{${name}}}.`);
    used.add(name);
    return values[name];
  });
  const missing = Object.keys(values).find((name) => !used.has(name));
  if (missing !== undefined) throw new Error(`The shader template has no placeholder {{${missing}}}.`);
  return text;
}
