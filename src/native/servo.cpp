#include "bindings.h"

namespace clamber {

void bind_servo(nb::module_&) {}

}  // namespace clamber
