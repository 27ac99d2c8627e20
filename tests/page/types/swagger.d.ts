// What docs.js uses of Swagger UI's bundle, which publishes no types.

export interface SwaggerUI {
  (options: { [name: string]: unknown }): void;
  presets: { apis: unknown };
}
