// Types of elements' parts (server/static/lib/dom.js).

type Value = string | number | boolean | null | undefined;
export interface Attributes {
  style?: string | { [property: string]: string | number | undefined } | null;
  onclick?: (event: MouseEvent) => unknown;
  onsubmit?: (event: SubmitEvent) => unknown;
  [name: string]: Value | { [property: string]: string | number | undefined } | ((event: never) => unknown);
}
/** Content of an element: texts, elements, attributes, lists of them; null, undefined and false are nothing. */
export type Part = Node | Attributes | Value | readonly Part[];
export type Made<Spec extends string> = Spec extends `${infer Tag}.${string}` ? Made<Tag> : Spec extends keyof HTMLElementTagNameMap ? HTMLElementTagNameMap[Spec] : never;
export type Drawn = HTMLElement | SVGElement;
/** An element that may have the focus. */
export type Control = HTMLElement & { disabled?: boolean; labels?: NodeListOf<HTMLLabelElement> | null };
export type Column<Row> = readonly [heading: string, cell: (row: Row) => Part, options?: { numeric?: boolean; unseen?: boolean }];
/** Functions to call when a screen is left. */
export type Ends = (() => unknown)[];
