// ================================================================================================
// rosbayes: bm1_table, for simulators of Verilog
// Reads a copy of the MIF in the format of $readmemh, whose name ends in .mif.hex.
// MIT licence; datasheet: docs/hardware/bm1_table.md
// ================================================================================================

module bm1_table #(
    parameter FILE_NAME = "",
    parameter WORD_BITS = 1,
    parameter DEPTH = 1,
    parameter ADDRESS_BITS = 1,
    parameter FIRST_BIT = 0,
    parameter DATA_BITS = 1
) (
    input wire clk_i,
    input wire enable_i,
    input wire [ADDRESS_BITS-1:0] address_i,
    output reg [DATA_BITS-1:0] data_o
);

  reg [WORD_BITS-1:0] memory[0:DEPTH-1];

  initial $readmemh({FILE_NAME, ".hex"}, memory);

  always @(posedge clk_i) if (enable_i) data_o <= memory[address_i][FIRST_BIT+:DATA_BITS];

endmodule
